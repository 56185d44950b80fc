//! `Knn`: the k nearest points of each state.

use wayfold_index::Search;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    check::{self, Violations},
    neighbors::Asked,
};

impl Service {
    /// The k nearest points of each state, optionally within a radius.
    pub async fn knn(
        &self,
        call: &Call,
        request: v1::KnnRequest,
    ) -> Result<v1::KnnResponse, Error> {
        self.accept(call)?;
        let at = request.at.unwrap_or_default();
        let hosted = self.index(&request.index, &at.uid)?;
        let mut violations = Violations::default();
        let k = check::k("k", request.k, self.limits(), &mut violations)?;
        let mut wanted = Search::nearest_k(k);
        if let Some(radius) = request.radius {
            check::radius("radius", radius, &mut violations);
            wanted.radius = radius;
        }
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
        Ok(v1::KnnResponse {
            neighbors: Some(told.neighbors),
            exact: told.exact,
            revision: told.revision,
            uid: told.uid,
        })
    }
}
