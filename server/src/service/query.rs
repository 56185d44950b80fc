//! `Query`: all points within a radius of each state.

use wayfold_proto::v1;

use super::{
    Call, Error, Service, check::Violations, neighbor_spec::NeighborSpec,
    neighbors::NeighborRequest,
};

impl Service {
    /// All points within a radius of each state, the closed ball, nearest first.
    pub async fn query(
        &self,
        call: &Call,
        request: v1::QueryRequest,
    ) -> Result<v1::QueryResponse, Error> {
        self.accept(call)?;
        let hosted = self.index(&request.index, "")?;
        let mut violations = Violations::default();
        if request.reach.is_none() {
            let text = "set radius or scaled_radius; an infinite radius finds all points";
            violations.add("radius", "REQUIRED", text);
        }
        let spec = NeighborSpec::check(
            "",
            None,
            request.reach.map(Into::into),
            hosted.space(),
            self.limits(),
            &mut violations,
        )?;
        let asked = NeighborRequest {
            states: request.states,
            epsilon: request.epsilon,
            filter: request.filter,
            include: request.include,
            min_revision: request.min_revision,
        };
        let (neighbors, revision) = self
            .neighbors(call, hosted, asked, spec, violations)
            .await?;
        Ok(v1::QueryResponse {
            neighbors: Some(neighbors),
            revision: Some(revision),
        })
    }
}
