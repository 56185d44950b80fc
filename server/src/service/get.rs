//! `Get`: points by id.

use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{PointColumns, Room, Seen},
    at::check_read_at,
    check::{self, Violations},
};

impl Service {
    /// Reads points by id, in the order of the request.
    pub async fn get(
        &self,
        call: &Call,
        request: v1::GetRequest,
    ) -> Result<v1::GetResponse, Error> {
        self.accept(call)?;
        let at = request.at.unwrap_or_default();
        let hosted = self.index(&request.index, &at.uid)?;
        let mut pace = call.pace("while reading points");
        check::id_count(&request.ids, self.limits())?;
        let mut violations = Violations::default();
        check::ids(&request.ids, &mut pace, &mut violations).await?;
        check_read_at(&at, &mut violations);
        violations.finish()?;

        let published = self.published(call, &hosted, &at, 0).await?;
        let seen = Seen {
            index: hosted.name(),
            published: &published,
        };
        let mut room = Room::new(self.limits());
        let mut points = PointColumns::new(request.payloads);
        let mut missing = Vec::new();
        for &id in &request.ids {
            match published.snapshot.get(id) {
                Some(point) if missing.is_empty() => {
                    let before = points.bytes();
                    points.push(&seen, point)?;
                    room.take(points.bytes() - before)?;
                }
                Some(_) => {}
                None => missing.push(id),
            }
            pace.step().await?;
        }
        if !missing.is_empty() {
            return Err(Error::PointsNotFound {
                index: request.index,
                ids: missing,
            });
        }
        Ok(v1::GetResponse {
            points: Some(points.finish()),
            revision: published.revision,
            uid: hosted.uid_text().into(),
        })
    }
}
