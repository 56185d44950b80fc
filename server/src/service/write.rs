//! `Write`: the net effect of a session's batch of steps.

use std::{
    collections::{HashMap, hash_map},
    sync::Arc,
};

use bytes::Bytes;
use wayfold_index::PointRef;
use wayfold_proto::{
    END_OF_IDS,
    v1::{self, StepKind},
};

use super::{
    Call, Error, Limits, Service,
    call::TimeSlicer,
    changed_points::ChangedPoints,
    check::{self, Rows, Violations},
    mutation::{IdempotencyKey, Start},
    payloads::hold_column,
    read_view::revision,
    session::{block, reserve},
};
use crate::{
    identity::Role,
    log::{Effects, Outcome},
    registry::{Hosted, Writer},
};

const DOING: &str = "while evaluating the steps; nothing was changed";

/// A checked batch.
struct Steps {
    session: u64,
    steps: Vec<(StepKind, u64)>,
    /// One a step, or none.
    tags: Vec<u64>,
    /// One a put or replacement.
    rows: Rows,
    /// One a put, replacement or step that sets one, or none.
    payloads: Vec<Bytes>,
}

/// The net effect of a batch on the point under an id.
enum NetEffect {
    /// The put with this number stores it, with this tag and the payload with this number.
    Put {
        row: usize,
        tag: u64,
        payload: usize,
    },
    /// It gets this tag, and the payload with this number.
    Updated {
        tag: u64,
        payload: Option<usize>,
    },
    Removed,
}

/// True if a step of this kind has a state.
fn has_state(kind: StepKind) -> bool {
    matches!(kind, StepKind::Put | StepKind::Replace)
}

/// True if a step of this kind has a payload.
fn has_payload(kind: StepKind) -> bool {
    has_state(kind) || kind == StepKind::SetPayload
}

impl Service {
    /// Applies the next batch of a writer session.
    pub async fn write(
        &self,
        call: &Call,
        mut request: v1::WriteRequest,
    ) -> Result<v1::WriteResponse, Error> {
        let hosted = self.index(call, Role::Write, &request.index_name, &request.uid)?;
        let _payloads = hold_column(call, &request.payloads)?;
        if let Some(answer) = self.forward(call, &hosted, &request).await {
            return answer;
        }
        let _counted = Arc::clone(&hosted.batches);
        let mut pace = call.pace(DOING);
        let mut key = IdempotencyKey::of_batch(&mut request, &mut pace).await?;
        let reserve_count = request.reserve_count;
        let steps = Steps::check(request, &hosted, self.limits(), &mut pace).await?;

        let mut stored = ChangedPoints::new(call);
        let updated = steps.updated();
        loop {
            let begun = self.begin_with(call, &hosted, Some(&key), &mut stored, &updated);
            let mut writer = match begun.await? {
                Start::Remembered(response) => return Ok(response),
                Start::Writing(writer) => writer,
            };
            writer.index_pending();
            let evaluated = steps.net(&hosted, &writer, &stored, &mut pace).await;
            let evaluated = evaluated.and_then(|(effects, missing)| {
                let limits = self.limits();
                let reserved = reserve(&hosted, &writer, &effects, reserve_count, limits, &[])?;
                let response = v1::WriteResponse {
                    reserved: Some(block(&reserved)),
                    missing_count: missing,
                    revision: Some(revision(&hosted, writer.revision() + 1)),
                };
                key.reserve(reserved);
                Ok((effects, response))
            });
            let committed = self.commit(call, &hosted, writer, Some(&key), evaluated);
            if let Some(response) = committed.await? {
                return Ok(response);
            }
        }
    }
}

impl Steps {
    async fn check(
        request: v1::WriteRequest,
        hosted: &Hosted,
        limits: &Limits,
        pace: &mut TimeSlicer,
    ) -> Result<Self, Error> {
        let count = request.kinds.len();
        let advice = "split the steps over several batches";
        check::at_most("max_rows_per_call", limits.max_rows_per_call, count, advice)?;
        let mut violations = Violations::default();
        if request.uid.is_empty() {
            let text = "a session belongs to one uid: give the one that OpenSession returned";
            violations.add("uid", "REQUIRED", text);
        }
        if request.ids.len() != count {
            let text = format!(
                "{} entries for {count} steps: one a step",
                request.ids.len()
            );
            violations.add("ids", "COUNT", text);
        }
        let mut steps = Vec::with_capacity(count);
        let (mut states, mut payloads) = (0, 0);
        for (at, (&kind, &id)) in request.kinds.iter().zip(&request.ids).enumerate() {
            let kind = StepKind::try_from(kind).unwrap_or_default();
            if kind == StepKind::Unspecified {
                let text = "it is none of PUT, REMOVE, SET_TAG, REPLACE and SET_PAYLOAD";
                violations.add(format!("kinds[{at}]"), "UNKNOWN_VALUE", text);
            }
            if id >= END_OF_IDS {
                let text = format!("{id}: ids are below 2^63");
                violations.add(format!("ids[{at}]"), "ID_TOO_LARGE", text);
            }
            if violations.are_enough() {
                break;
            }
            states += usize::from(has_state(kind));
            payloads += usize::from(has_payload(kind));
            steps.push((kind, id));
            if at % 1024 == 1023 {
                pace.step().await?;
            }
        }
        check::column("tags", &request.tags, count, &mut violations);
        check::column("payloads", &request.payloads, payloads, &mut violations);
        check::payloads(&request.payloads, limits, &mut violations);
        let rows = request.states.unwrap_or_default();
        if rows.row_count as usize != states {
            let text = format!(
                "{} rows for {states} puts and replacements: one each",
                rows.row_count
            );
            violations.add("states.row_count", "COUNT", text);
        }
        let rows = check::states(hosted.space(), Some(rows), limits, pace, &mut violations);
        let rows = rows.await?;
        violations.finish()?;
        Ok(Self {
            session: request.session,
            steps,
            tags: request.tags,
            rows,
            payloads: request.payloads,
        })
    }

    /// The ids of points that get a tag or a payload, each once.
    fn updated(&self) -> Vec<u64> {
        let updates = |kind| matches!(kind, StepKind::SetTag | StepKind::SetPayload);
        let updated = self.steps.iter().filter(|(kind, _)| updates(*kind));
        let mut ids: Vec<u64> = updated.map(|(_, id)| *id).collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// The effects on the writer's newest state, and the number of removals, tags, payloads and replacements of ids
    /// that were not stored. `stored` has the points that get a tag or a payload.
    async fn net(
        &self,
        hosted: &Hosted,
        writer: &Writer,
        stored: &ChangedPoints,
        pace: &mut TimeSlicer,
    ) -> Result<(Effects, u64), Error> {
        let count = self.steps.len();
        let (mut nets, mut order) = (HashMap::with_capacity(count), Vec::with_capacity(count));
        let (mut missing, mut row, mut payload) = (0, 0, 0);
        for (at, &(kind, id)) in self.steps.iter().enumerate() {
            pace.step().await?;
            let tag = self.tags.get(at).copied().unwrap_or_default();
            let (held_tag, net) = match nets.entry(id) {
                hash_map::Entry::Occupied(entry) => entry.into_mut(),
                hash_map::Entry::Vacant(entry) => {
                    order.push(id);
                    entry.insert((writer.get(id).map(|point| point.tag), None))
                }
            };
            // The tag that the point has before this step.
            let old_tag = match net {
                Some(NetEffect::Put { tag, .. } | NetEffect::Updated { tag, .. }) => Some(*tag),
                Some(NetEffect::Removed) => None,
                None => *held_tag,
            };
            match (kind, old_tag, &mut *net) {
                (StepKind::Put, ..) => *net = Some(NetEffect::Put { row, tag, payload }),
                (_, None, _) | (StepKind::Unspecified, ..) => missing += 1,
                (StepKind::Replace, Some(tag), _) => {
                    *net = Some(NetEffect::Put { row, tag, payload })
                }
                (StepKind::Remove, ..) => *net = Some(NetEffect::Removed),
                (
                    StepKind::SetTag,
                    _,
                    Some(NetEffect::Put { tag: new, .. } | NetEffect::Updated { tag: new, .. }),
                ) => *new = tag,
                (StepKind::SetTag, ..) => *net = Some(NetEffect::Updated { tag, payload: None }),
                (StepKind::SetPayload, _, Some(NetEffect::Put { payload: new, .. })) => {
                    *new = payload
                }
                (StepKind::SetPayload, Some(tag), _) => {
                    let payload = Some(payload);
                    *net = Some(NetEffect::Updated { tag, payload });
                }
            }
            row += usize::from(has_state(kind));
            payload += usize::from(has_payload(kind));
        }
        let mut effects = Effects::new(hosted.space().coordinates());
        let mut reserved = Vec::new();
        for id in order {
            pace.step().await?;
            match nets.remove(&id) {
                Some((held_tag, Some(NetEffect::Put { row, tag, payload }))) => {
                    let is_held = held_tag.is_some();
                    let owner = || writer.sessions().owner(id);
                    if !is_held && owner().is_some_and(|owner| owner != self.session) {
                        reserved.push(id);
                    }
                    let outcome = match is_held {
                        true => Outcome::Replaced,
                        false => Outcome::Inserted,
                    };
                    let point = PointRef {
                        id,
                        tag,
                        revision: writer.revision() + 1,
                        row: self.rows.row(row),
                    };
                    effects.store(point, outcome, self.payload(payload));
                }
                Some((_, Some(NetEffect::Updated { tag, payload }))) => {
                    let Some(held) = stored.get(id) else {
                        continue;
                    };
                    let new = payload.map(|payload| self.payload(payload));
                    let payload = new.unwrap_or_else(|| held.payload.clone());
                    if tag != held.tag || payload != held.payload {
                        let point = PointRef {
                            tag,
                            ..held.indexed()
                        };
                        effects.store(point, Outcome::Updated, payload);
                    }
                }
                Some((Some(_), Some(NetEffect::Removed))) => effects.remove(id),
                Some((None, Some(NetEffect::Removed)) | (_, None)) | None => {}
            }
        }
        match reserved.is_empty() {
            true => Ok((effects, missing)),
            false => Err(Error::IdsReserved {
                index: hosted.name().into(),
                ids: reserved,
            }),
        }
    }

    /// The payload with this number.
    fn payload(&self, number: usize) -> Bytes {
        // A copy: the request's payloads are slices that keep the whole message alive.
        let payload = self.payloads.get(number);
        payload.map_or_else(Bytes::new, |it| Bytes::copy_from_slice(it))
    }
}
