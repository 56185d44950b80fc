//! The newest points, before they become part of a level: few enough to be searched from end to end.

use crate::{
    PointRef, Points,
    blocks::Blocks,
    kernel::{BLOCK, Set},
    search::Walk,
};

/// A small table, all of it alive. It is copied if a snapshot holds it when it changes.
#[derive(Debug)]
pub(super) struct Buffer {
    points: Points,
    /// The same rows, for search.
    blocks: Blocks,
}

impl Buffer {
    pub(super) fn new(coordinates: usize) -> Self {
        Self {
            points: Points::new(coordinates),
            blocks: Blocks::with_capacity(coordinates, 0),
        }
    }

    pub(super) fn points(&self) -> &Points {
        &self.points
    }

    pub(super) fn into_points(self) -> Points {
        self.points
    }

    pub(super) fn push(&mut self, point: PointRef<'_>) {
        self.blocks.write(self.points.len(), point.row);
        self.points.push_point(point);
    }

    /// Removes the point in `slot`; the last one takes its place.
    pub(super) fn swap_remove(&mut self, slot: usize) {
        let last = self.points.len() - 1;
        self.blocks.write(slot, self.points.row(last));
        self.points.swap_remove(slot);
        self.blocks.truncate(last);
    }

    /// A copy with room for `rows` rows in all.
    pub(super) fn copy_with_room(&self, rows: usize) -> Self {
        Self {
            points: self.points.copy_with_room(rows),
            blocks: self.blocks.copy_with_room(rows),
        }
    }

    /// Shows `walk` all points.
    #[inline(always)]
    pub(super) fn visit<'a, S: Set>(&'a self, walk: &mut Walk<'a>) {
        for start in (0..self.points.len()).step_by(BLOCK) {
            let lanes = (self.points.len() - start).min(BLOCK);
            let block = self.blocks.block(start / BLOCK);
            walk.scan::<S>(block, lanes, &self.points, |lane| start + lane, |_| true);
        }
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.points.memory_bytes() + self.blocks.memory_bytes()
    }

    /// Checks that the blocks hold the rows.
    pub(super) fn validate(&self) -> Result<(), String> {
        for (slot, point) in self.points.iter().enumerate() {
            if !self.blocks.row(slot).eq(point.row.iter().copied()) {
                return Err(format!("point {} differs in its block", point.id));
            }
        }
        Ok(())
    }
}
