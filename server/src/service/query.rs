//! `Query`: all points within a radius of each state.

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    check::Violations,
    neighbors::Asked,
    wanted::{Said, Wanted},
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
        let scaling = request.scaling;
        if request.radius.is_none() && scaling.is_none() {
            violations.add(
                "radius",
                "REQUIRED",
                "set the radius; infinity asks for all points",
            );
        }
        if scaling.is_some_and(|scaling| scaling.k_factor.is_some()) {
            violations.add(
                "scaling.k_factor",
                "NOT_APPLICABLE",
                "a Query is for all within a radius; Knn is for a number",
            );
        }
        let said = Said {
            k: None,
            radius: request.radius,
            scaling,
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
        Ok(v1::QueryResponse {
            neighbors: Some(told.neighbors),
            exact: told.exact,
            revision: told.revision,
            uid: told.uid,
        })
    }
}
