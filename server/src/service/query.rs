//! `Query`: all points within a radius of each state.

use wayfold_index::Search;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{Found, Room, Seen, search},
    at::check_read_at,
    check::{self, Violations},
};

impl Service {
    /// All points within a radius of each state, the closed ball, nearest first.
    pub async fn query(
        &self,
        call: &Call,
        request: v1::QueryRequest,
    ) -> Result<v1::QueryResponse, Error> {
        self.accept(call)?;
        let limits = self.limits();
        let at = request.at.unwrap_or_default();
        let hosted = self.index(&request.index, &at.uid)?;
        let mut pace = call.pace("while searching");
        let mut violations = Violations::default();

        check::radius("radius", request.radius, &mut violations);
        let mut wanted = Search::nearest_r(request.radius);
        check::accuracy(
            &mut wanted,
            request.epsilon,
            request.max_leaves,
            &mut violations,
        );
        wanted.filter = check::filter(
            "filter",
            request.filter,
            ("at.uid", &at.uid),
            &mut violations,
        );
        check_read_at(&at, &mut violations);
        let space = hosted.space();
        let states =
            check::states(space, request.states, limits, &mut pace, &mut violations).await?;
        violations.finish()?;

        let published = self.published(call, &hosted, &at).await?;
        let seen = Seen {
            index: hosted.name(),
            published: &published,
        };
        let found = Found::new(request.include, space.coordinates(), Room::new(limits));
        let (neighbors, exact) = search(&seen, &states, wanted, found, &mut pace).await?;
        Ok(v1::QueryResponse {
            neighbors: Some(neighbors),
            exact,
            revision: published.revision,
            uid: hosted.uid_text().into(),
        })
    }
}
