//! `VerifyIndex`: compares the forest with the stored points at one pinned revision.
//!
//! Two passes read the stored points, one page in memory at a time: the first compares them with the forest's
//! (`compare`), the second answers sampled queries by brute force (`search`). `sample` draws the states.

mod compare;
mod sample;
mod search;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use wayfold_proto::v1::{self, verify_index_response::Result as Answer};

use super::{
    Call, Error, Service,
    check::Violations,
    indexes::describe,
    read_view::{revision_number, uid_of},
    revision_pin::RevisionPin,
    stored,
};
use crate::{
    identity::Role,
    log::{StoredPoint, View},
    registry::{Hosted, Published},
};
use compare::Comparison;
use search::{Searches, query_bytes};

/// Points read from the log at once.
const PAGE_ROWS: usize = 256;

/// A page ends with the point by which it has this many bytes.
const PAGE_BYTES: usize = 1024 * 1024;

/// Time between two messages of progress.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(250);

/// The maximum number of disagreements that the report describes.
const MAX_DESCRIPTIONS: usize = 10;

const DOING: &str = "while verifying";

/// A running verification. It pins its revision until it ends, is dropped, or its time is up.
pub struct Verification {
    call: Call,
    hosted: Arc<Hosted>,
    pinned_revision: RevisionPin,
    queries: usize,
    k: usize,
    disagreements: Disagreements,
    stage: Phase,
}

enum Phase {
    Comparing(Box<Comparison>),
    /// With the number of stored points and their hash.
    Searching(Searches, u64, [u8; 32]),
    Done,
}

impl Service {
    /// Begins to verify an index.
    pub async fn verify_index(
        &self,
        call: &Call,
        request: v1::VerifyIndexRequest,
    ) -> Result<Verification, Error> {
        let uid = uid_of(request.min_revision.as_ref());
        let hosted = self.index(call, Role::Read, &request.index_name, uid)?;
        let mut violations = Violations::default();
        let min = request.min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        let mut within = |field, requested: Option<u32>, default, least, most| {
            let requested = requested.unwrap_or(default);
            if !(least..=most).contains(&requested) {
                let text = format!("{requested}; it is from {least} to {most}");
                violations.add(field, "OUT_OF_RANGE", text);
            }
            requested as usize
        };
        let queries = within("query_count", request.query_count, 32, 0, 1000);
        let k = within("k", request.k, 10, 1, 100);
        violations.finish()?;

        let published = self.published(call, &hosted, min, false).await?;
        let comparison = Comparison::new(hosted.space(), queries.div_ceil(2), request.seed);
        Ok(Verification {
            call: call.clone(),
            hosted,
            pinned_revision: RevisionPin::new(published, self.limits().max_scan_seconds),
            queries,
            k,
            disagreements: Disagreements::default(),
            stage: Phase::Comparing(Box::new(comparison)),
        })
    }
}

impl Verification {
    /// The next message takes at most this many bytes beside [`Verification::kept_bytes`]: a page, and the table of its
    /// states, which doubles while it grows.
    pub(crate) fn next_bytes(&self) -> usize {
        match self.stage {
            Phase::Done => 0,
            _ => 3 * PAGE_BYTES,
        }
    }

    /// The most bytes that it keeps between two messages.
    pub(crate) fn kept_bytes(&self) -> usize {
        self.queries * query_bytes(self.hosted.space(), self.k)
    }

    /// The progress or the result; None after the result or an error.
    pub async fn next(&mut self) -> Option<Result<v1::VerifyIndexResponse, Error>> {
        if matches!(self.stage, Phase::Done) {
            return None;
        }
        let answer = self.work().await;
        if !matches!(answer, Ok(Answer::Progress(_))) {
            self.stage = Phase::Done;
            self.pinned_revision.release();
        }
        let response = |answer| v1::VerifyIndexResponse {
            result: Some(answer),
        };
        Some(answer.map(response))
    }

    /// Works for a while, or to the end.
    async fn work(&mut self) -> Result<Answer, Error> {
        let published = held(&self.pinned_revision)?;
        let until = Instant::now() + PROGRESS_INTERVAL;
        let pass = Pass {
            call: &self.call,
            index: self.hosted.name(),
            published: &published,
            pinned_revision: &self.pinned_revision,
            until,
        };
        let per_pass = published.snapshot.len() as u64;
        let passes = if self.queries > 0 { 2 } else { 1 };
        let progress = |read_point_count| {
            Answer::Progress(v1::VerifyProgress {
                read_point_count,
                total_point_count: passes * per_pass,
            })
        };
        if let Phase::Comparing(comparison) = &mut self.stage {
            if !comparison.go_on(&pass, &mut self.disagreements).await? {
                return Ok(progress(comparison.read));
            }
            let states = comparison.sampler.draw(self.queries);
            let searches = Searches::new(states, self.k);
            let (read, hash) = (comparison.read, comparison.hash());
            self.stage = Phase::Searching(searches, read, hash);
        }
        let Phase::Searching(searches, stored, hash) = &mut self.stage else {
            return Err(Error::Internal {
                what: "a verification went on after its end".into(),
            });
        };
        if !searches.go_on(&pass).await? {
            return Ok(progress(*stored + searches.read));
        }
        searches.compare(&mut self.disagreements);
        Ok(Answer::Report(v1::VerifyReport {
            index: Some(describe(&self.hosted, &published)),
            stored_point_count: *stored,
            content_hash: hash.to_vec(),
            query_count: self.queries as u64,
            disagreement_count: self.disagreements.count,
            first_disagreements: std::mem::take(&mut self.disagreements.first),
        }))
    }
}

fn held(pinned_revision: &RevisionPin) -> Result<Arc<Published>, Error> {
    pinned_revision.get().ok_or(Error::HeldTooLong {
        what: "verification",
        max_scan_seconds: pinned_revision.seconds,
    })
}

/// The inputs of both passes over the stored points.
struct Pass<'a> {
    call: &'a Call,
    index: &'a str,
    published: &'a Published,
    pinned_revision: &'a RevisionPin,
    /// When progress is due.
    until: Instant,
}

impl Pass<'_> {
    /// The stored points after an id; none at the end.
    async fn page(&self, after: Option<u64>) -> Result<Vec<Arc<StoredPoint>>, Error> {
        held(self.pinned_revision)?;
        let read = move |view: &dyn View| view.page_within(after, PAGE_ROWS, PAGE_BYTES);
        // Damage of this copy is `DATA_LOSS`, in a cluster too.
        stored::read_copy(
            self.call,
            DOING,
            self.index,
            (&self.published.view, false),
            read,
        )
        .await
    }

    fn has_time(&self) -> bool {
        Instant::now() < self.until
    }
}

/// The differences between the forest and the store.
#[derive(Default)]
struct Disagreements {
    count: u64,
    first: Vec<String>,
}

impl Disagreements {
    fn add(&mut self, words: impl FnOnce() -> String) {
        self.count += 1;
        if self.first.len() < MAX_DESCRIPTIONS {
            self.first.push(words());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{arm, engine, server};

    #[tokio::test]
    async fn a_page_of_large_payloads_has_few_points() {
        let log = engine(&arm(), 60);
        let service = server(&log, &log);
        let request = v1::VerifyIndexRequest {
            index_name: "arm".into(),
            ..Default::default()
        };
        let verification = service.verify_index(&Call::default(), request).await;
        let verification = verification.unwrap();
        let published = held(&verification.pinned_revision).unwrap();
        let pass = Pass {
            call: &verification.call,
            index: "arm",
            published: &published,
            pinned_revision: &verification.pinned_revision,
            until: Instant::now(),
        };
        let (mut after, mut points) = (None, 0);
        loop {
            let page = pass.page(after).await.unwrap();
            let Some(last) = page.last() else {
                break;
            };
            after = Some(last.id);
            points += page.len();
            let bytes: usize = page.iter().map(|point| point.bytes()).sum();
            assert!(bytes < PAGE_BYTES + last.bytes(), "{bytes}");
        }
        assert_eq!(points, 60);
    }
}
