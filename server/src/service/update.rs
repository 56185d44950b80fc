//! `Update`: new tags and payloads for stored points.

use bytes::Bytes;
use wayfold_index::PointRef;
use wayfold_proto::v1;

use super::{
    Call, Error, Limits, Service,
    call::TimeSlicer,
    changed_points::ChangedPoints,
    check::{self, Violations},
    mutation::{IdempotencyKey, Start},
    payloads::hold_column,
    read_view::{check_uid, revision, uid_is_named},
};
use crate::{
    identity::Role,
    log::{Effects, Outcome},
    registry::Hosted,
};

const DOING: &str = "while evaluating the update; nothing was changed";

impl Service {
    /// Sets tags or payloads of stored points; their states, and the revisions of their states, stay.
    pub async fn update(
        &self,
        call: &Call,
        request: v1::UpdateRequest,
    ) -> Result<v1::UpdateResponse, Error> {
        let hosted = self.index(call, Role::Write, &request.index_name, &request.uid)?;
        let _payloads = hold_column(call, &request.payloads)?;
        if let Some(answer) = self.forward(call, &hosted, &request).await {
            return answer;
        }
        let mut pace = call.pace(DOING);
        let key = IdempotencyKey::of("Update", &request.operation_id, &request, &mut pace).await?;
        let if_revision = check_update(&request, &hosted, self.limits(), &mut pace).await?;

        let mut stored = ChangedPoints::new(call);
        loop {
            let writer = match self
                .begin_with(call, &hosted, key.as_ref(), &mut stored, &request.ids)
                .await?
            {
                Start::Remembered(response) => return Ok(response),
                Start::Writing(writer) => writer,
            };
            let evaluated = updated(&request, if_revision, &stored, &hosted, &mut pace).await;
            let evaluated = evaluated.map(|effects| {
                let updated = effects.len() as u64;
                let after = writer.revision() + u64::from(updated > 0);
                let response = v1::UpdateResponse {
                    updated_count: updated,
                    unchanged_count: request.ids.len() as u64 - updated,
                    revision: Some(revision(&hosted, after)),
                };
                (effects, response)
            });
            let committed = self.commit(call, &hosted, writer, key.as_ref(), evaluated);
            if let Some(response) = committed.await? {
                return Ok(response);
            }
        }
    }
}

/// The effects of an update on the stored points.
async fn updated(
    request: &v1::UpdateRequest,
    if_revision: Option<u64>,
    stored: &ChangedPoints,
    hosted: &Hosted,
    pace: &mut TimeSlicer,
) -> Result<Effects, Error> {
    let mut effects = Effects::new(hosted.space().coordinates());
    let (mut missing, mut changed) = (Vec::new(), Vec::new());
    for (at, &id) in request.ids.iter().enumerate() {
        pace.step().await?;
        let Some(held) = stored.get(id) else {
            missing.push(id);
            continue;
        };
        if if_revision.is_some_and(|revision| held.modified > revision) {
            changed.push(id);
            continue;
        }
        let tag = match request.tags.get(at).or(request.tags.first()) {
            Some(tag) => set_bits(held.tag, *tag, request.tag_mask),
            None => held.tag,
        };
        // A copy: the request's payloads are slices of the message, and would keep all of it.
        let payload = match request.payloads.get(at) {
            Some(payload) if *payload != held.payload => Bytes::copy_from_slice(payload),
            _ => held.payload.clone(),
        };
        if tag != held.tag || payload != held.payload {
            let point = PointRef {
                tag,
                ..held.indexed()
            };
            effects.store(point, Outcome::Updated, payload);
        }
    }
    if !missing.is_empty() {
        return Err(Error::PointsNotFound {
            index: request.index_name.clone(),
            ids: missing,
        });
    }
    if let Some(if_revision) = if_revision.filter(|_| !changed.is_empty()) {
        return Err(Error::RevisionConflict {
            index: request.index_name.clone(),
            if_revision,
            ids: changed,
        });
    }
    Ok(effects)
}

/// Checks a request; the number of the revision that it compares with, if there is one.
async fn check_update(
    request: &v1::UpdateRequest,
    hosted: &Hosted,
    limits: &Limits,
    pace: &mut TimeSlicer,
) -> Result<Option<u64>, Error> {
    check::id_count(&request.ids, limits)?;
    let mut violations = Violations::default();
    check::ids(&request.ids, pace, &mut violations).await?;
    if request.tags.len() != 1 {
        check::column("tags", &request.tags, request.ids.len(), &mut violations);
    }
    if let Some(mask) = request.tag_mask {
        if request.tags.is_empty() {
            violations.add("tags", "REQUIRED", "tag_mask is set, and there is no tag");
        }
        for (at, tag) in request.tags.iter().enumerate() {
            if tag & !mask != 0 {
                let text = format!("{tag:#x} has bits outside tag_mask = {mask:#x}");
                violations.add(format!("tags[{at}]"), "OUTSIDE_MASK", text);
            }
        }
    }
    check::column(
        "payloads",
        &request.payloads,
        request.ids.len(),
        &mut violations,
    );
    check::payloads(&request.payloads, limits, &mut violations);
    check::operation_id(&request.operation_id, &mut violations);
    let if_revision = match &request.if_revision {
        Some(named) => {
            uid_is_named("if_revision", &named.uid, &mut violations);
            check_uid(hosted, &named.uid)?;
            Some(named.number)
        }
        None => None,
    };
    violations.finish()?;
    Ok(if_revision)
}

/// `old` with the bits of `mask` taken from `new`; without a mask all of them are.
fn set_bits(old: u64, new: u64, mask: Option<u64>) -> u64 {
    let mask = mask.unwrap_or(u64::MAX);
    (old & !mask) | (new & mask)
}
