//! `Knn`: the k nearest points of each state.

use wayfold_proto::v1;

use super::{
    Call, Error, Service, check::Violations, neighbor_spec::NeighborSpec,
    neighbors::NeighborRequest,
};

impl Service {
    /// The k nearest points of each state, optionally within a radius.
    pub async fn knn(
        &self,
        call: &Call,
        request: v1::KnnRequest,
    ) -> Result<v1::KnnResponse, Error> {
        self.accept(call)?;
        let hosted = self.index(&request.index, "")?;
        let mut violations = Violations::default();
        if request.count.is_none() {
            violations.add("k", "REQUIRED", "set k or k_factor");
        }
        let spec = NeighborSpec::check(
            "",
            request.count.map(Into::into),
            request.reach.map(Into::into),
            hosted.space(),
            self.limits(),
            &mut violations,
        )?;
        let request_fields = NeighborRequest {
            states: request.states,
            epsilon: request.epsilon,
            filter: request.filter,
            include: request.include,
            min_revision: request.min_revision,
        };
        let (neighbors, revision) = self
            .neighbors(call, hosted, request_fields, spec, violations)
            .await?;
        Ok(v1::KnnResponse {
            neighbors: Some(neighbors),
            revision: Some(revision),
        })
    }
}
