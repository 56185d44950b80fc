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
        let wanted = match request.radius {
            Some(radius) => {
                check::radius("radius", radius, &mut violations);
                Search::nearest_r(radius)
            }
            None => {
                violations.add(
                    "radius",
                    "REQUIRED",
                    "set the radius; infinity asks for all points",
                );
                Search::nearest_r(0.0)
            }
        };
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
