//! `Insert`: states become points.

mod evaluation;

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::{Point, Search};
use wayfold_proto::v1;

use self::evaluation::Evaluation;
use super::{
    Call, Error, Limits, Service,
    call::TimeSlicer,
    check::{self, Rows, Violations},
    mutation::{IdempotencyKey, Start, refused},
    neighbor_spec::NeighborSpec,
    payloads::{Payloads, UnreadPayloads, hold_column},
    prefetch::Prefetch,
    read_view::revision,
    stored::MAX_READS_AHEAD,
};
use crate::{
    identity::Role,
    registry::{Hosted, Published},
};

const DOING: &str = "while evaluating the rows; nothing was changed";

/// From this many searching rows on, an insert first merges the pending changes: merging costs less than it saves then.
const MANY_ROWS: usize = 1000;

/// A checked request.
struct Insertion {
    rows: Rows,
    /// The ids, one a row; if empty, the server assigns them.
    ids: Vec<u64>,
    /// The tags, one a row, or none.
    tags: Vec<u64>,
    /// The payloads, one a row, or none.
    payloads: Vec<Bytes>,
    replace: bool,
    min_separation: f64,
    neighbors: Option<(NeighborSpec, Option<v1::Include>)>,
}

impl Service {
    /// Inserts states; rows apply in order, and a row sees the rows before it.
    pub async fn insert(
        &self,
        call: &Call,
        request: v1::InsertRequest,
    ) -> Result<v1::InsertResponse, Error> {
        let hosted = self.index(call, Role::Write, &request.index_name, &request.uid)?;
        let _payloads = hold_column(call, &request.payloads)?;
        if let Some(answer) = self.forward(call, &hosted, &request).await {
            return answer;
        }
        let mut pace = call.pace(DOING);
        let key = IdempotencyKey::of("Insert", &request.operation_id, &request, &mut pace).await?;
        let insertion = Insertion::check(request, &hosted, self.limits(), &mut pace).await?;

        let mut base = hosted.published();
        let prefetch = insertion.prefetch(call, &base, self.limits(), &mut pace);
        let prefetch = prefetch.await?;
        let mut payloads = Payloads::new(call, insertion.answers_payloads());
        let expected = insertion.unread_in(&base, prefetch.as_ref(), &mut pace);
        let expected = expected.await?;
        let most = self.limits().max_answer_bytes;
        payloads.read(call, &hosted, &base, expected, most).await?;
        let (mut reads, mut held) = (1, None);
        loop {
            let mut writer = match held.take() {
                Some(writer) => writer,
                None => match self.begin(call, &hosted, key.as_ref()).await? {
                    Start::Remembered(response) => return Ok(response),
                    Start::Writing(writer) => writer,
                },
            };
            base = Arc::clone(writer.base());
            payloads.catch_up(&hosted, &writer);
            if insertion.looks_up() {
                writer.index_pending();
            }
            if insertion.is_searched() && insertion.rows.len() >= MANY_ROWS {
                writer.settle_pending();
            }
            let prefetch = prefetch.as_ref().filter(|prefetch| prefetch.holds(&writer));
            let evaluation = Evaluation::new(
                call,
                &insertion,
                &hosted,
                &writer,
                self.limits(),
                prefetch,
                &payloads,
            );
            let mut evaluation = match evaluation {
                Ok(evaluation) => evaluation,
                Err(error) => {
                    refused(call, &hosted, writer, error).await?;
                    continue;
                }
            };
            if let Err(error) = insertion.evaluate(&mut evaluation, &mut pace).await {
                drop(evaluation);
                refused(call, &hosted, writer, error).await?;
                continue;
            }
            let unread = std::mem::take(&mut evaluation.unread);
            if unread.is_empty() {
                // The response holds its bytes while the mutation is committed.
                let (evaluated, _held) = match evaluation.finish() {
                    Ok((effects, mut response, held)) => {
                        let after = writer.revision() + u64::from(!effects.is_empty());
                        response.revision = Some(revision(&hosted, after));
                        (Ok((effects, response)), held)
                    }
                    Err(error) => (Err(error), None),
                };
                let committed = self.commit(call, &hosted, writer, key.as_ref(), evaluated);
                if let Some(response) = committed.await? {
                    return Ok(response);
                }
                continue;
            }
            drop(evaluation);
            // Other writers changed the index: read the rest, without the writer if possible, then evaluate the rows
            // again.
            if reads < MAX_READS_AHEAD {
                drop(writer);
            } else {
                held = Some(writer);
            }
            reads += 1;
            payloads.read(call, &hosted, &base, unread, most).await?;
        }
    }
}

impl Insertion {
    /// The search for a point within `min_separation`.
    fn nearest(&self) -> Option<Search<'static>> {
        let is_set = self.min_separation > 0.0;
        is_set.then(|| Search {
            radius: self.min_separation,
            ..Search::nearest_k(1)
        })
    }

    /// Searches the published revision for the rows.
    async fn prefetch(
        &self,
        call: &Call,
        published: &Published,
        limits: &Limits,
        pace: &mut TimeSlicer,
    ) -> Result<Option<Prefetch>, Error> {
        if !self.is_searched() {
            return Ok(None);
        }
        // An insert that requests more neighbours than an answer holds fails.
        let most = limits.max_answer_bytes / 16;
        let (points, rows) = (published.snapshot.len(), self.rows.len());
        let neighbors = self
            .neighbors
            .map(|(spec, _)| spec.prefetch_search(points, rows));
        let nearest = self.nearest();
        let (held, rows) = (call.answer_bytes(), &self.rows);
        let prefetch = Prefetch::search(published, rows, neighbors, nearest, most, held, pace);
        prefetch.await.map(Some)
    }

    /// Evaluates the rows in order, up to an error that may vanish once more payloads are read.
    async fn evaluate(
        &self,
        evaluation: &mut Evaluation<'_>,
        pace: &mut TimeSlicer,
    ) -> Result<(), Error> {
        for (at, row) in self.rows.iter().enumerate() {
            match evaluation.row(at, row) {
                Ok(()) => {}
                // The error may vanish once the payloads of earlier rows are read.
                Err(_) if !evaluation.unread.compared.is_empty() => break,
                Err(error) => return Err(error),
            }
            // A search or the copy of a large payload takes long.
            if self.is_searched() || !self.payloads.is_empty() || at % 32 == 31 {
                pace.step().await?;
            }
        }
        Ok(())
    }

    /// The payload of a row.
    fn payload(&self, at: usize) -> &[u8] {
        self.payloads.get(at).map_or(&[], |payload| payload)
    }

    /// The payloads of `published` that the rows most likely compare with or answer.
    async fn unread_in(
        &self,
        published: &Published,
        prefetch: Option<&Prefetch>,
        pace: &mut TimeSlicer,
    ) -> Result<UnreadPayloads, Error> {
        let mut compared = Vec::new();
        for (at, (&id, row)) in self.ids.iter().zip(self.rows.iter()).enumerate() {
            let tag = self.tags.get(at).copied().unwrap_or_default();
            let held = published.snapshot.get(id);
            if held.is_some_and(|held| is_same(&held, tag, row)) {
                compared.push(id);
            }
            if at % 32 == 31 {
                pace.step().await?;
            }
        }
        let prefetch = prefetch.filter(|_| self.answers_payloads());
        Ok(UnreadPayloads {
            compared,
            neighbors: prefetch.map(Prefetch::neighbor_ids).unwrap_or_default(),
        })
    }

    /// True if the answer has the payloads of neighbours.
    fn answers_payloads(&self) -> bool {
        let include = self.neighbors.and_then(|(_, include)| include);
        include.is_some_and(|include| include.with_payloads)
    }

    /// True if the evaluation looks for stored points.
    fn looks_up(&self) -> bool {
        self.is_searched() || !self.ids.is_empty()
    }

    /// True if rows must find the rows before them.
    fn is_searched(&self) -> bool {
        self.min_separation > 0.0 || self.neighbors.is_some()
    }

    async fn check(
        request: v1::InsertRequest,
        hosted: &Hosted,
        limits: &Limits,
        pace: &mut TimeSlicer,
    ) -> Result<Self, Error> {
        let space = hosted.space();
        let mut violations = Violations::default();
        let replace = match v1::OnConflict::try_from(request.on_conflict) {
            Ok(v1::OnConflict::Unspecified | v1::OnConflict::Fail) => false,
            Ok(v1::OnConflict::Replace) => true,
            Err(_) => {
                let text = format!("{} is no value of OnConflict", request.on_conflict);
                violations.add("on_conflict", "UNKNOWN_VALUE", text);
                false
            }
        };
        check::finite("min_separation", request.min_separation, &mut violations);
        check::operation_id(&request.operation_id, &mut violations);
        let neighbors = match request.neighbor_spec {
            Some(spec) => {
                if spec.k_form.is_none() && spec.radius_form.is_none() {
                    let text = "set k or k_factor, radius or scaled_radius, or one of each";
                    violations.add("neighbor_spec", "REQUIRED", text);
                }
                let include = spec.include;
                let spec =
                    NeighborSpec::check("neighbor_spec.", spec, hosted, limits, &mut violations)?;
                Some((spec, include))
            }
            None => None,
        };
        let count = request
            .states
            .as_ref()
            .map_or(0, |states| states.row_count as usize);
        let rows = check::states(space, request.states, limits, pace, &mut violations).await?;
        check::column("ids", &request.ids, count, &mut violations);
        check::column("tags", &request.tags, count, &mut violations);
        check::column("payloads", &request.payloads, count, &mut violations);
        check::ids(&request.ids, pace, &mut violations).await?;
        check::payloads(&request.payloads, limits, &mut violations);
        violations.finish()?;
        Ok(Self {
            rows,
            ids: request.ids,
            tags: request.tags,
            payloads: request.payloads,
            replace,
            min_separation: request.min_separation,
            neighbors,
        })
    }
}

/// True if a stored point has this tag and, bit for bit, this state.
fn is_same(held: &Point, tag: u64, row: &[f64]) -> bool {
    let mut coordinates = held.row.iter().zip(row);
    held.tag == tag && coordinates.all(|(held, new)| held.to_bits() == new.to_bits())
}
