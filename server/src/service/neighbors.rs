//! What `Knn` and `Query` have in common: everything but which neighbours they want.

use std::sync::Arc;

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{Found, ReadView, Room, search},
    check::{self, Violations},
    neighbor_spec::NeighborSpec,
    read_view::{revision, revision_number},
};
use crate::registry::Hosted;

const DOING: &str = "while searching";

/// What a request says beside which neighbours it wants.
pub(super) struct NeighborRequest {
    pub(super) states: Option<v1::States>,
    pub(super) epsilon: f64,
    pub(super) filter: Option<v1::Filter>,
    pub(super) include: Option<v1::Include>,
    pub(super) min_revision: Option<v1::Revision>,
}

impl Service {
    /// Checks the rest of a request, waits for its revision, and searches for every state. The size of the index at that
    /// revision completes `spec`; `violations` has what is wrong with it.
    pub(super) async fn neighbors(
        &self,
        call: &Call,
        hosted: Arc<Hosted>,
        asked: NeighborRequest,
        mut spec: NeighborSpec,
        mut violations: Violations,
    ) -> Result<(v1::Neighbors, v1::Revision), Error> {
        let NeighborRequest {
            states,
            epsilon,
            filter,
            include,
            min_revision,
        } = asked;
        let (limits, space) = (self.limits(), hosted.space());
        let mut pace = call.pace(DOING);
        check::finite("epsilon", epsilon, &mut violations);
        spec.fixed.epsilon = epsilon;
        let filter = check::filter("filter", filter, &hosted, &mut violations)?;
        spec.fixed.filter = filter;
        let min = min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        let states = check::states(space, states, limits, &mut pace, &mut violations).await?;
        violations.finish()?;

        let min = min.max(filter.since_revision);
        let published = self.published(call, &hosted, min).await?;
        let mut completed = spec.among(published.snapshot.len())?;
        completed.until = call.deadline;
        let view = ReadView {
            call,
            doing: DOING,
            index: hosted.name(),
            published: &published,
        };
        let found = Found::new(include, space.coordinates(), Room::new(limits));
        let neighbors = search(&view, &states, completed, found, &mut pace).await?;
        Ok((neighbors, revision(&hosted, published.revision)))
    }
}
