//! What `Knn` and `Query` have in common: everything but which neighbours they want.

use std::sync::Arc;

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{Found, Room, Seen, search},
    at::check_read_at,
    check::{self, Violations},
    wanted::Wanted,
};
use crate::registry::Hosted;

const DOING: &str = "while searching";

/// What a request says beside which neighbours it wants.
pub(super) struct Asked {
    pub(super) states: Option<v1::States>,
    pub(super) epsilon: f64,
    pub(super) max_leaves: u32,
    pub(super) filter: Option<v1::Filter>,
    pub(super) include: Option<v1::Include>,
    pub(super) at: v1::ReadAt,
}

/// What is answered.
pub(super) struct Told {
    pub(super) neighbors: v1::Neighbors,
    pub(super) exact: bool,
    pub(super) revision: u64,
    pub(super) uid: String,
}

impl Service {
    /// Checks the rest of a request, waits for its revision, and searches for every state. `wanted` has the limits of
    /// number and radius, which the size of the index at that revision completes, and `violations` what is wrong with them.
    pub(super) async fn neighbors(
        &self,
        call: &Call,
        hosted: Arc<Hosted>,
        asked: Asked,
        mut wanted: Wanted,
        mut violations: Violations,
    ) -> Result<Told, Error> {
        let Asked {
            states,
            epsilon,
            max_leaves,
            filter,
            include,
            at,
        } = asked;
        let (limits, space) = (self.limits(), hosted.space());
        let mut pace = call.pace(DOING);
        let fixed = &mut wanted.fixed;
        check::accuracy(fixed, epsilon, max_leaves, &mut violations);
        fixed.filter = check::filter("filter", filter, ("at.uid", &at.uid), &mut violations);
        check_read_at(&at, &mut violations);
        let states = check::states(space, states, limits, &mut pace, &mut violations).await?;
        violations.finish()?;

        let since_revision = wanted.fixed.filter.since_revision;
        let published = self.published(call, &hosted, &at, since_revision).await?;
        let mut wanted = wanted.among(published.snapshot.len())?;
        wanted.until = call.deadline;
        let seen = Seen {
            call,
            doing: DOING,
            index: hosted.name(),
            published: &published,
        };
        let found = Found::new(include, space.coordinates(), Room::new(limits));
        let (neighbors, exact) = search(&seen, &states, wanted, found, &mut pace).await?;
        Ok(Told {
            neighbors,
            exact,
            revision: published.revision,
            uid: hosted.uid_text().into(),
        })
    }
}
