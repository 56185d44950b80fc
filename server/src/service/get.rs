//! `Get`: points by id.

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{AnswerBudget, PointColumns, missing, payload_bytes},
    check::{self, Violations},
    read_view::{ReadView, revision, revision_number, uid_of},
    stored::BATCH_ROWS,
};
use crate::identity::Role;

const DOING: &str = "while reading points";

impl Service {
    /// Reads points by id, in the order of the request.
    pub async fn get(
        &self,
        call: &Call,
        request: v1::GetRequest,
    ) -> Result<v1::GetResponse, Error> {
        let uid = uid_of(request.min_revision.as_ref());
        let hosted = self.index(call, Role::Read, &request.index_name, uid)?;
        let mut pace = call.pace(DOING);
        check::id_count(&request.ids, self.limits())?;
        let mut violations = Violations::default();
        check::ids(&request.ids, &mut pace, &mut violations).await?;
        let min = request.min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        violations.finish()?;

        let published = self.published(call, &hosted, min, request.latest).await?;
        let mut absent = Vec::new();
        for &id in &request.ids {
            if published.snapshot.get(id).is_none() {
                absent.push(id);
            }
            pace.step().await?;
        }
        if !absent.is_empty() {
            return Err(Error::PointsNotFound {
                index: request.index_name,
                ids: absent,
            });
        }
        let view = ReadView {
            call,
            doing: DOING,
            index: hosted.name(),
            published: &published,
        };
        let mut budget = AnswerBudget::new(self.limits(), call);
        let mut points = PointColumns::new(request.include);
        for ids in request.ids.chunks(BATCH_ROWS) {
            let mut payloads = match points.with_payloads() {
                true => {
                    let most = budget.left;
                    let payloads = view.payloads(ids.to_vec(), most, &mut budget.held);
                    payloads.await?
                }
                false => Vec::new(),
            }
            .into_iter();
            for &id in ids {
                let point = published.snapshot.get(id).ok_or_else(|| missing(id))?;
                let payload = payloads.next();
                // Fails at the last payload if they exceed the budget.
                let of_payload = payload.as_ref().map_or(0, payload_bytes);
                budget.take_held(of_payload)?;
                let before = points.bytes() + of_payload;
                points.push(point.by_ref(), payload);
                budget.take(points.bytes() - before)?;
                pace.step().await?;
            }
        }
        Ok(v1::GetResponse {
            points: Some(points.finish()),
            revision: Some(revision(&hosted, published.revision)),
        })
    }
}
