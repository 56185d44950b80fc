//! `POST /api/v1/INDEX/points`: all points at one revision, and then each mutation, as frames of columns.
//!
//! A frame is two lengths (u32), a head (JSON) and a body, all little-endian; head and body are padded to multiples of
//! eight bytes. docs/page.md describes the heads. Numbers of a body are columns: `ids`, `revisions` and `tags` (u64), then
//! the coordinates row by row (f32: for pictures, not for answers).

mod frame;

use std::{sync::Arc, time::Duration};

use axum::{
    body::Body,
    extract::{Path, RawQuery, State as Of},
    http::{HeaderMap, header},
    response::{IntoResponse, Response},
};
use bytes::Bytes;
use futures_util::stream;
use serde_json::{Value, json};
use tokio::{sync::OwnedSemaphorePermit, time::timeout};
use tracing::Instrument;
use wayfold_proto::v1;

use super::api::{Admitted, Api, MAX_STREAMS, refusal, text};
use crate::{
    observe::Ending,
    service::{Error, Scan, Watch},
    status::{self, Status},
    verbs::invalid,
};
use frame::{Frames, Share};

/// The default of `max`.
const DEFAULT_MAX: u64 = 1_000_000;

/// The pause after a message of a watch: a picture needs no more, and each costs the server a little.
const PAUSE: Duration = Duration::from_millis(100);

/// A stream without mutations says after this time that it lives.
const MAX_SILENCE: Duration = Duration::from_secs(10);

/// The parameters of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
struct PointsRequest {
    index: String,
    /// The most points to send first. Of more, an even sample is sent.
    max: u64,
    /// True to send the mutations too.
    follow: bool,
    /// True to send the edges too, for indices whose payloads are ids.
    edges: bool,
    /// The revision that the caller has, to send only what came after it.
    after: Option<v1::Revision>,
}

impl PointsRequest {
    fn read(index: String, query: &str) -> Result<Self, Error> {
        let mut asked = Self {
            index,
            max: DEFAULT_MAX,
            follow: false,
            edges: false,
            after: None,
        };
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let malformed = |expected: &str| {
                invalid(
                    name,
                    "MALFORMED_PARAMETER",
                    format!("{value:?} is {expected}"),
                )
            };
            match name {
                "max" => {
                    asked.max = value
                        .parse()
                        .ok()
                        .filter(|max| *max > 0)
                        .ok_or_else(|| malformed("no number of points from 1"))?;
                }
                "follow" | "edges" => {
                    let value = value
                        .parse()
                        .map_err(|_| malformed("neither true nor false"))?;
                    match name {
                        "follow" => asked.follow = value,
                        _ => asked.edges = value,
                    }
                }
                "after" => {
                    let (uid, number) = value
                        .split_once(':')
                        .ok_or_else(|| malformed("no revision, UID:NUMBER"))?;
                    asked.after = Some(v1::Revision {
                        uid: uid.into(),
                        number: number
                            .parse()
                            .map_err(|_| malformed("no revision, UID:NUMBER"))?,
                    });
                }
                _ => {
                    let text = "there are max, follow, edges and after";
                    return Err(invalid(name, "UNKNOWN_PARAMETER", text));
                }
            }
        }
        Ok(asked)
    }

    /// The columns that are read.
    fn include(&self) -> v1::Include {
        v1::Include {
            states: true,
            tags: true,
            revisions: true,
            payloads: self.edges,
        }
    }
}

/// Answers with the stream of an index.
pub(super) async fn points(
    Of(api): Of<Arc<Api>>,
    Path(index): Path<String>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
) -> Response {
    let Ok(place) = Arc::clone(&api.streams).try_acquire_owned() else {
        return refusal(&status::too_many_calls("streams", MAX_STREAMS));
    };
    let admitted = match api.admit("points", &headers, true) {
        Ok(admitted) => admitted,
        Err(status) => return refusal(&status),
    };
    let asked = match PointsRequest::read(index, query.as_deref().unwrap_or_default()) {
        Ok(asked) => asked,
        Err(error) => return refusal(&status::from_error(&error)),
    };
    let span = admitted.record.span().clone();
    let mut points = PointStream {
        source: match asked.after.clone() {
            Some(after) => Source::After(after),
            None => Source::All,
        },
        asked,
        api,
        admitted,
        share: Share::ALL,
        reached: 0,
        _place: place,
    };
    // What can be refused at once is an answer of its own, not a stream.
    let first = match points.step().instrument(span.clone()).await {
        Ok(first) => first.unwrap_or_default(),
        Err(status) => {
            points.admitted.record.end(Ending::Failed(status.code));
            return refusal(&status);
        }
    };
    let rest = stream::unfold((Some(first), points), move |(first, mut points)| {
        let span = span.clone();
        async move {
            let frames = match first {
                Some(first) => first,
                None => points.next().instrument(span).await?,
            };
            Some((Ok::<_, std::convert::Infallible>(frames), (None, points)))
        }
    });
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (headers, Body::from_stream(rest)).into_response()
}

/// A running stream.
struct PointStream {
    api: Arc<Api>,
    admitted: Admitted,
    asked: PointsRequest,
    source: Source,
    share: Share,
    /// The last revision that was sent whole.
    reached: u64,
    _place: OwnedSemaphorePermit,
}

/// Where the next frames come from.
enum Source {
    /// Nothing was sent.
    All,
    /// Nothing was sent, and the caller has all points at this revision.
    After(v1::Revision),
    Scan(Box<Scan>, Option<v1::Revision>),
    Watch(Box<Watch>),
    End,
}

impl PointStream {
    /// The next frames; None at the end.
    async fn next(&mut self) -> Option<Bytes> {
        match self.step().await {
            Ok(frames) => {
                if frames.is_none() {
                    self.admitted.record.end(Ending::Ok);
                }
                frames
            }
            Err(status) => {
                self.admitted.record.end(Ending::Failed(status.code));
                self.source = Source::End;
                let mut frames = Frames::default();
                let status: Value = serde_json::from_slice(&text(&status)).unwrap_or_default();
                frames.push(&json!({ "kind": "failed", "status": status }), &[]);
                Some(frames.finish())
            }
        }
    }

    async fn step(&mut self) -> Result<Option<Bytes>, Status> {
        loop {
            let source = std::mem::replace(&mut self.source, Source::End);
            let (source, frames) = match source {
                Source::End => return Ok(None),
                Source::All => (self.scan().await?, Frames::default()),
                Source::After(after) => {
                    self.reached = after.number;
                    (self.watch(after).await?, Frames::default())
                }
                Source::Scan(scan, revision) => self.scanned(scan, revision).await?,
                Source::Watch(watch) => self.watched(watch).await?,
            };
            self.source = source;
            if !frames.is_empty() {
                return Ok(Some(frames.finish()));
            }
        }
    }

    /// Does a part of the work in a turn.
    async fn in_turn<T>(
        turns: &mut crate::admission::CallTurns,
        work: impl Future<Output = Result<T, Error>>,
    ) -> Result<T, Status> {
        let done = turns.run(work).await.map_err(status::overloaded)?;
        done.map_err(|error| status::from_error(&error))
    }

    async fn scan(&mut self) -> Result<Source, Status> {
        let request = v1::ScanRequest {
            index_name: self.asked.index.clone(),
            include: Some(self.asked.include()),
            ..Default::default()
        };
        let Admitted { call, turns, .. } = &mut self.admitted;
        let scan = Self::in_turn(turns, self.api.shared.service.scan(call, request)).await?;
        Ok(Source::Scan(Box::new(scan), None))
    }

    async fn watch(&mut self, after: v1::Revision) -> Result<Source, Status> {
        let request = v1::WatchRequest {
            index_name: self.asked.index.clone(),
            after_revision: Some(after),
            include: Some(self.asked.include()),
            ..Default::default()
        };
        let Admitted { call, turns, .. } = &mut self.admitted;
        let watch = Self::in_turn(turns, self.api.shared.service.watch(call, request)).await?;
        Ok(Source::Watch(Box::new(watch)))
    }

    /// The next part of a scan. `revision` is the one that it reads, once it is known.
    async fn scanned(
        &mut self,
        mut scan: Box<Scan>,
        revision: Option<v1::Revision>,
    ) -> Result<(Source, Frames), Status> {
        let mut frames = Frames::default();
        let next = async { scan.next().await.transpose() };
        let Some(part) = Self::in_turn(&mut self.admitted.turns, next).await? else {
            let revision = revision.unwrap_or_default();
            self.reached = revision.number;
            frames.push(&json!({ "kind": "at", "revision": self.reached }), &[]);
            let source = match self.asked.follow {
                true => self.watch(revision).await?,
                false => Source::End,
            };
            return Ok((source, frames));
        };
        let points = part.points.unwrap_or_default();
        let read = match revision {
            Some(revision) => revision,
            None => {
                self.share = Share::of(self.asked.max, part.point_count);
                let read = part.revision.unwrap_or_default();
                let coordinates = scan.coordinates();
                let head = json!({
                    "kind": "begin", "uid": read.uid, "revision": read.number, "coordinates": coordinates,
                    "points": part.point_count, "share": self.share.fraction(),
                });
                frames.push(&head, &[]);
                read
            }
        };
        frames.push_points(&points, self.share);
        if self.asked.edges && !frames.push_edges(&points, self.share) {
            // Payloads that are no ids may be large: they are not read for nothing.
            self.asked.edges = false;
            scan.omit_payloads();
        }
        Ok((Source::Scan(scan, Some(read)), frames))
    }

    /// The next mutations.
    async fn watched(&mut self, mut watch: Box<Watch>) -> Result<(Source, Frames), Status> {
        let mut frames = Frames::default();
        let next = async {
            // A wait that is cut loses no message.
            match timeout(MAX_SILENCE, watch.next()).await {
                Ok(message) => message.transpose().map(Some),
                Err(_) => Ok(None),
            }
        };
        let message = match Self::in_turn(&mut self.admitted.turns, next).await? {
            Some(Some(message)) => message,
            Some(None) => return Ok((Source::End, frames)),
            None => {
                frames.push(&json!({ "kind": "at", "revision": self.reached }), &[]);
                return Ok((Source::Watch(watch), frames));
            }
        };
        if message.reset.is_some() {
            let reason = message.reset().as_str_name();
            let reason = reason.trim_start_matches("RESET_REASON_");
            frames.push(&json!({ "kind": "reset", "reason": reason }), &[]);
            return Ok((Source::All, frames));
        }
        for mutation in &message.mutations {
            let number = mutation.revision.as_ref().map_or(0, |it| it.number);
            if let Some(stored) = &mutation.stored {
                frames.push_points(stored, self.share);
                if self.asked.edges {
                    self.asked.edges = frames.push_edges(stored, self.share);
                }
            }
            frames.push_removed(&mutation.removed_ids, number, self.share);
            if !mutation.continued {
                self.reached = number;
            }
        }
        frames.push(&json!({ "kind": "at", "revision": self.reached }), &[]);
        if !message.mutations.is_empty() {
            let _ = timeout(PAUSE, std::future::pending::<()>()).await;
        }
        Ok((Source::Watch(watch), frames))
    }
}
