//! `Query`: all points within a radius of each state.

use wayfold_index::Search;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    check::{self, Violations},
    neighbors::Asked,
};

impl Service {
    /// All points within a radius of each state, the closed ball, nearest first.
    pub async fn query(
        &self,
        call: &Call,
        request: v1::QueryRequest,
    ) -> Result<v1::QueryResponse, Error> {
        self.accept(call)?;
        let at = request.at.unwrap_or_default();
        let hosted = self.index(&request.index, &at.uid)?;
        let mut violations = Violations::default();
        check::radius("radius", request.radius, &mut violations);
        let wanted = Search::nearest_r(request.radius);
        let asked = Asked {
            states: request.states,
            epsilon: request.epsilon,
            max_leaves: request.max_leaves,
            filter: request.filter,
            include: request.include,
            at,
        };
        let told = self
            .neighbors(call, hosted, asked, wanted, violations)
            .await?;
        Ok(v1::QueryResponse {
            neighbors: Some(told.neighbors),
            exact: told.exact,
            revision: told.revision,
            uid: told.uid,
        })
    }
}
