//! The points of a snapshot, one after the other.

use std::collections::VecDeque;

use wayfold_index::{ForestSnapshot, Point, ScannedPoints};

/// The points that are copied at once.
const PAGE_ROWS: usize = 1_024;

/// The points of a snapshot, which the iterator holds, by ascending id.
pub(super) fn scan<E>(snapshot: ForestSnapshot) -> ScannedPoints<E> {
    let (mut page, mut after, mut is_over) = (VecDeque::new(), None, false);
    Box::new(std::iter::from_fn(move || {
        if page.is_empty() && !is_over {
            page.extend(snapshot.points_after(after).take(PAGE_ROWS));
            is_over = page.len() < PAGE_ROWS;
            after = page.back().map(|point: &Point| point.id);
        }
        page.pop_front().map(Ok)
    }))
}
