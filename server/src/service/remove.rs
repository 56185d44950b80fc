//! `Remove`: points by id.

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    check::{self, Violations},
    mutation::{IdempotencyKey, Start},
    read_view::revision,
};
use crate::{identity::Role, log::Effects};

impl Service {
    /// Removes points by id, and counts those that were not stored.
    pub async fn remove(
        &self,
        call: &Call,
        request: v1::RemoveRequest,
    ) -> Result<v1::RemoveResponse, Error> {
        let hosted = self.index(call, Role::Write, &request.index_name, &request.uid)?;
        if let Some(answer) = self.forward(call, &hosted, &request).await {
            return answer;
        }
        let mut pace = call.pace("while looking up the points; nothing was changed");
        let key = IdempotencyKey::of("Remove", &request.operation_id, &request, &mut pace).await?;
        check::id_count(&request.ids, self.limits())?;
        let mut violations = Violations::default();
        check::ids(&request.ids, &mut pace, &mut violations).await?;
        check::operation_id(&request.operation_id, &mut violations);
        violations.finish()?;

        loop {
            let mut writer = match self.begin(call, &hosted, key.as_ref()).await? {
                Start::Remembered(response) => return Ok(response),
                Start::Writing(writer) => writer,
            };
            writer.index_pending();
            let mut effects = Effects::new(hosted.space().coordinates());
            for &id in &request.ids {
                if writer.get(id).is_some() {
                    effects.remove(id);
                }
                pace.step().await?;
            }
            let removed = effects.len() as u64;
            let after = writer.revision() + u64::from(removed > 0);
            let response = v1::RemoveResponse {
                removed_count: removed,
                missing_count: request.ids.len() as u64 - removed,
                revision: Some(revision(&hosted, after)),
            };
            let evaluated = Ok((effects, response));
            let committed = self.commit(call, &hosted, writer, key.as_ref(), evaluated);
            if let Some(response) = committed.await? {
                return Ok(response);
            }
        }
    }
}
