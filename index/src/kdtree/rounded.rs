//! The rows of a tree once more, in a quarter of the memory, where a search is bound by reading them.
//!
//! In many dimensions all points are about equally far away, and a search that has its neighbours still reads most of the
//! rows, only to find that they are farther. That can be told by rounded numbers: a block is read only if one of its points,
//! moved by what rounding may have moved it, is near enough.

use crate::{
    Kernels, Points, Space,
    blocks::Blocks,
    kernel::{BLOCK, CODES, Coding},
};

/// How many blocks of rows a block of codes is of.
pub(super) const PAIR: usize = CODES / BLOCK;

/// From so many dimensions on rows are read more than boxes.
const LEAST_DIMENSION: usize = 9;

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
    /// The codes of these points, in the order of their blocks, in spaces and on processors where they help; None where
    /// [`Coding::of`] is.
    pub(super) fn where_it_helps(space: &Space, points: &Points, blocks: &Blocks) -> Option<Self> {
        let is_heavy = space.parts().iter().any(|part| part.weight > MOST_WEIGHT);
        // Without wide registers, to read codes takes longer than to read rows.
        let is_wide = Kernels::default().are_wide();
        if space.dimension() < LEAST_DIMENSION || is_heavy || !is_wide {
            return None;
        }
        Self::new(space, points, blocks)
    }

    fn new(space: &Space, points: &Points, blocks: &Blocks) -> Option<Self> {
        let coding = Coding::of(space, points)?;
        let width = space.coordinates();
        let columns = blocks.numbers().chunks_exact(BLOCK);
        let mut codes = vec![0; columns.len().div_ceil(PAIR * width) * width * CODES];
        for (at, column) in columns.enumerate() {
            let (block, axis) = (at / width, at % width);
            let start = (block / PAIR * width + axis) * CODES + block % PAIR * BLOCK;
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
        let codes = &self.codes[block / PAIR * self.block_len..][..self.block_len];
        (codes, block % PAIR * BLOCK)
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
            let tree = KdTree::new(space.clone(), points.clone(), leaf_rows).unwrap();
            tree.validate().unwrap();
            let found = tree
                .search(&row(query), &Search::nearest_r(radius))
                .unwrap();
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
    fn nothing_is_lost_where_a_coordinate_weighs_so_much_that_its_square_vanishes() {
        for (space, narrow, query) in [
            ("R15*R1:1e160", 1e-90, 1.5e-162),
            ("R15*R1:1e200", 1e-90, 1e-163),
            ("R16:1e200", 1e-195, 1e-163),
            ("R16:1e130", 1e-157, 1e-163),
            ("sum((R7*R1:1e200), R8)", 1e-90, 1.5e-162),
        ] {
            let space: Space = space.parse().unwrap();
            let width = space.coordinates();
            let row = |narrow: f64, last: f64| {
                let mut row = vec![narrow; width];
                row[width - 1] = last;
                row
            };
            let mut points = Points::new(width);
            for id in 0..50 {
                points.push(id, 0, 1, &row(narrow * (id % 7) as f64, 0.0));
            }
            let asked = row(narrow, query);
            let tree = KdTree::new(space.clone(), points.clone(), BLOCK).unwrap();
            for radius in points.iter().map(|point| space.distance(point.row, &asked)) {
                let near = |row: &[f64]| space.distance(row, &asked) <= radius;
                let expected = points.iter().filter(|point| near(point.row)).count();
                let found = tree
                    .search(&asked, &Search::nearest_r(radius))
                    .unwrap()
                    .neighbors;
                assert_eq!(found.len(), expected, "{space} {radius}");
            }
        }
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
        let wide = Kernels::default().are_wide();
        assert_eq!([rounded("R9", 1.0), rounded("R9", 1e90)], [wide; 2]);
        assert!(!rounded("R8", 1.0));
        // Keys in steps would be out of range.
        assert!(!rounded("R9", 1e140) && !rounded("R9", 1e-140) && !rounded("R9:1e201", 1.0));
        assert!(!rounded("R9", 0.0));
    }
}
