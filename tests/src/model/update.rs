//! Updates of tags.

use wayfold_index::PointRef;
use wayfold_proto::v1::{UpdateRequest, UpdateResponse};

use super::Model;
use crate::number;

impl Model {
    /// Checks the answer to an update of tags, and applies it. The checker of histories compares `if_revision`.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does, and if the update is more than tags.
    pub fn update(&mut self, request: &UpdateRequest, response: &UpdateResponse) {
        assert!(request.tag_mask.is_none() && request.payloads.is_empty());
        assert_eq!(request.tags.len(), request.ids.len());
        let mut updated = 0;
        for (&id, &tag) in request.ids.iter().zip(&request.tags) {
            let stored = self.points.get(id).expect("a point that is stored");
            if stored.tag == tag {
                continue;
            }
            let (row, revision) = (stored.row.to_vec(), stored.revision);
            let point = PointRef {
                id,
                tag,
                revision,
                row: &row,
            };
            self.points.insert(point).expect("a canonical row");
            updated += 1;
        }
        self.revision += u64::from(updated > 0);
        let unchanged = request.ids.len() as u64 - updated;
        assert_eq!(
            (
                response.updated_count,
                response.unchanged_count,
                number(&response.revision)
            ),
            (updated, unchanged, self.revision),
            "{request:?}"
        );
    }
}
