//! `Knn`: the k nearest points of each state.

use wayfold_index::Search;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{Found, Room, Seen, search},
    at::check_read_at,
    check::{self, Violations},
};

impl Service {
    /// The k nearest points of each state, optionally within a radius.
    pub async fn knn(
        &self,
        call: &Call,
        request: v1::KnnRequest,
    ) -> Result<v1::KnnResponse, Error> {
        self.accept(call)?;
        let limits = self.limits();
        let at = request.at.unwrap_or_default();
        let hosted = self.index(&request.index, &at.uid)?;
        let mut pace = call.pace("while searching");
        let mut violations = Violations::default();

        let mut wanted = Search::nearest_k(check::k("k", request.k, limits, &mut violations)?);
        if let Some(radius) = request.radius {
            check::radius("radius", radius, &mut violations);
            wanted.radius = radius;
        }
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
        Ok(v1::KnnResponse {
            neighbors: Some(neighbors),
            exact,
            revision: published.revision,
            uid: hosted.uid_text().into(),
        })
    }
}
