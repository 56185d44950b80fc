//! The rows of a tree once more, in a quarter of the memory, where a search is bound by reading them.
//!
//! In many dimensions all points are about equally far away, and a search that has its neighbours still reads most of the
//! rows, only to find that they are farther. That can be told by rounded numbers: a block is read only if one of its points,
//! moved by what rounding may have moved it, is near enough.

use crate::{
    Points, Space,
    blocks::Blocks,
    kdtree::build::widen,
    kernel::{BLOCK, CODES, Coding},
};

/// From so many dimensions on rows are read more than boxes.
const LEAST_DIMENSION: usize = 8;

/// With a weight above this, of two points that are nearly the same one may be farther than `f64` can tell.
const MOST_WEIGHT: f64 = 1e200;

/// Blocks of rows, as codes.
#[derive(Clone, Debug)]
pub(super) struct Rounded {
    coding: Coding,
    /// Codes of a block.
    block_len: usize,
    codes: Vec<u16>,
}

impl Rounded {
    /// The rounded rows of these points, in the order of their blocks, in spaces where they help; None if a number is out of
    /// range.
    pub(super) fn where_it_helps(space: &Space, points: &Points, blocks: &Blocks) -> Option<Self> {
        let is_heavy = space.parts().iter().any(|part| part.weight > MOST_WEIGHT);
        if space.dimension() < LEAST_DIMENSION || is_heavy {
            return None;
        }
        Self::new(space, points, blocks)
    }

    fn new(space: &Space, points: &Points, blocks: &Blocks) -> Option<Self> {
        let width = space.coordinates();
        let (mut least, mut greatest) =
            (vec![f64::INFINITY; width], vec![f64::NEG_INFINITY; width]);
        for point in points.iter() {
            widen(&mut least, &mut greatest, point.row);
        }
        let coding = Coding::of(space, &least, &greatest)?;
        let blocks_of = blocks.numbers().len() / (width * BLOCK);
        let mut codes = vec![0; blocks_of.div_ceil(CODES / BLOCK) * width * CODES];
        for (at, column) in blocks.numbers().chunks_exact(BLOCK).enumerate() {
            let (block, axis) = (at / width, at % width);
            let start = block / 2 * width * CODES + axis * CODES + block % 2 * BLOCK;
            for (code, &x) in codes[start..].iter_mut().zip(column) {
                *code = coding.code(axis, x);
            }
        }
        Some(Self {
            codes,
            block_len: width * CODES,
            coding,
        })
    }

    /// The block of codes that those of a block of rows lie in, and their first place there.
    pub(super) fn codes(&self, block: usize) -> (&[u16], usize) {
        let (at, half) = (block * BLOCK / CODES, block * BLOCK % CODES);
        (&self.codes[at * self.block_len..][..self.block_len], half)
    }

    /// All blocks of codes, one after the other.
    pub(super) fn blocks(&self) -> impl Iterator<Item = &[u16]> {
        self.codes.chunks_exact(self.block_len)
    }

    /// What they mean.
    pub(super) fn coding(&self) -> &Coding {
        &self.coding
    }

    /// The bytes the codes hold.
    pub(super) fn memory_bytes(&self) -> usize {
        2 * self.codes.capacity()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{KdTree, Search};

    /// A tree of these numbers in the first coordinate finds all that lie within their distance of a query.
    fn all_are_found(space: &str, numbers: &[f64], query: f64) {
        let space: Space = space.parse().unwrap();
        let row = |number: f64| {
            let mut row = vec![0.0; space.coordinates()];
            row[0] = number;
            row
        };
        let mut points = Points::new(space.coordinates());
        for (id, &number) in (0..50).zip(numbers.iter().cycle()) {
            points.push(id, 0, 1, &row(number));
        }
        let distances = numbers
            .iter()
            .map(|&x| space.distance(&row(x), &row(query)));
        let radius = distances.fold(0.0, f64::max);
        for leaf_rows in [5, BLOCK, BLOCK + 1, 40] {
            let tree = KdTree::new(space.clone(), points.clone(), leaf_rows);
            tree.validate().unwrap();
            let found = tree.search(&row(query), &Search::nearest_r(radius));
            assert_eq!(found.neighbors.len(), 50, "{space} {leaf_rows}");
        }
    }

    #[test]
    fn nothing_is_lost_where_squares_are_out_of_range() {
        all_are_found("R16:1e5", &[1.5e-162], 1e-150);
        all_are_found("R16:1e308", &[1e-163], 1e-154);
        all_are_found("sum((R16:1e20), R1)", &[1e-162], 1e-154);
        all_are_found("sum((R16:1e300), R1)", &[100.1], 13_507.907_929);
        all_are_found("R16:1e-200", &[0.0, 1e149], -1e149);
        all_are_found("R16:1e200", &[0.0, 1e-120], 2e-120);
    }

    #[test]
    fn nothing_is_lost_where_steps_are_wide_or_all_numbers_equal() {
        all_are_found("R16", &[0.25], 0.5);
        all_are_found("R16", &[0.25, 0.75, 1e9], 0.5);
        all_are_found("R16", &[0.25, 0.75], 1e9);
        all_are_found("R16", &[1e9, 1e9 + 1e-6], 1e9 + 1e-3);
        all_are_found("sum((R1), (SO2^8):1e-9, (R7):1e-40)", &[0.25, 1.0], -7.0);
    }

    #[test]
    fn rows_are_rounded_where_that_helps() {
        let rounded = |space: &str, number: f64| {
            let space: Space = space.parse().unwrap();
            let (mut points, width) = (Points::new(space.coordinates()), space.coordinates());
            points.push(1, 0, 1, &vec![0.0; width]);
            points.push(2, 0, 1, &vec![number; width]);
            let mut blocks = Blocks::with_capacity(width, 2);
            for point in points.iter() {
                blocks.write(point.id as usize - 1, point.row);
            }
            Rounded::where_it_helps(&space, &points, &blocks).is_some()
        };
        assert!(rounded("R8", 1.0) && rounded("R8", 1e90));
        assert!(!rounded("R7", 1.0));
        // Keys in steps would be out of range.
        assert!(!rounded("R8", 1e140) && !rounded("R8", 1e-140) && !rounded("R8:1e201", 1.0));
        assert!(!rounded("R8", 0.0));
    }
}
