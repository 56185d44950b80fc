//! `Knn`: the k nearest points of each state.

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    check::Violations,
    neighbors::Asked,
    wanted::{Said, Wanted},
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
        let is_scaled = request
            .scaling
            .is_some_and(|scaling| scaling.k_factor.is_some());
        let said = Said {
            k: (request.k > 0 || !is_scaled).then_some(request.k),
            radius: request.radius,
            scaling: request.scaling,
        };
        let wanted = Wanted::check("", &said, hosted.space(), self.limits(), &mut violations)?;
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
