//! Rows quantised to 16 bits a coordinate, which rule out most blocks of rows in a quarter of the memory traffic. Such
//! a table is the VA-file of Weber, Schek and Blott ("A Quantitative Analysis and Performance Study for
//! Similarity-Search Methods in High-Dimensional Spaces", VLDB 1998).
//!
//! In many dimensions all points are about equally far away, and a search that has its neighbours still reads most
//! rows, only to find that they are farther. The codes show that: a block is read only if one of its points, moved by
//! as much as rounding may have moved it, is near enough.
//!
//! Measured without codes, as a multiple of the time with them: one tree of 50,000 uniform points, medians of single
//! searches, interleaved in one process, on an Intel Xeon (family 6, model 207, AVX-512, 2 MiB of L2), recorded at
//! e5760be on 23 November 2026.
//!
//! | | R12 | SE3² | SE3⁴ | R30 |
//! |---|---|---|---|---|
//! | k = 1 | 1.31 | 1.37 | 2.77 | 2.91 |
//! | k = 10 | 1.35 | 1.32 | 2.57 | 2.66 |

mod quantizer;
mod query;

use crate::{
    Kernels, Points, Space,
    blocks::Blocks,
    kernel,
    lanes::{BLOCK_ROWS, Isa},
};
pub(crate) use quantizer::Quantizer;
pub(crate) use query::{CODE_ROWS, QuantizedQuery};

/// The number of blocks of rows that share a block of codes.
pub(crate) const ROW_BLOCKS: usize = CODE_ROWS / BLOCK_ROWS;

/// The least dimension in which searches read more rows than boxes.
const MIN_DIMENSION: usize = 9;

/// The greatest weight with codes. Under a greater one, of two points that are nearly the same one may be farther than
/// `f64` can tell.
const MAX_WEIGHT: f64 = 1e200;

/// A bit for each row of a block of codes whose key may be up to `limit` before quantisation moved it by
/// [`QuantizedQuery::error`].
#[inline(always)]
pub(crate) fn codes<I: Isa>(
    space: &Space,
    query: &QuantizedQuery<'_>,
    codes: &[u16],
    limit: f64,
) -> u32 {
    let keys = kernel::keys::<I, f32, _>(space, &query::Codes { query, codes }).0;
    I::at_most(&keys, query.limit(limit))
}

/// The codes of the rows of a tree, in the order of its blocks.
#[derive(Clone, Debug)]
pub(crate) struct QuantizedRows {
    quantizer: Quantizer,
    /// The number of codes in a block.
    block_len: usize,
    codes: Vec<u16>,
}

impl QuantizedRows {
    /// The codes of these points; None in spaces and on processors where codes do not save time, and where
    /// [`Quantizer::of`] returns None.
    pub(crate) fn where_they_pay(space: &Space, points: &Points, blocks: &Blocks) -> Option<Self> {
        let is_heavy = space.parts().iter().any(|part| part.weight > MAX_WEIGHT);
        // Without wide registers, reading codes costs more than reading rows.
        let is_wide = Kernels::default().are_wide();
        if space.dimension() < MIN_DIMENSION || is_heavy || !is_wide {
            return None;
        }
        let quantizer = Quantizer::of(space, points)?;
        let width = space.coordinates();
        let columns = blocks.numbers().chunks_exact(BLOCK_ROWS);
        let mut codes = vec![0; columns.len().div_ceil(ROW_BLOCKS * width) * width * CODE_ROWS];
        for (at, column) in columns.enumerate() {
            let (block, axis) = (at / width, at % width);
            let start =
                (block / ROW_BLOCKS * width + axis) * CODE_ROWS + block % ROW_BLOCKS * BLOCK_ROWS;
            for (code, &x) in codes[start..].iter_mut().zip(column) {
                *code = quantizer.code(axis, x);
            }
        }
        Some(Self {
            codes,
            block_len: width * CODE_ROWS,
            quantizer,
        })
    }

    /// The block of codes that contains those of a block of rows, and their first lane in it.
    pub(crate) fn codes(&self, block: usize) -> (&[u16], usize) {
        let codes = &self.codes[block / ROW_BLOCKS * self.block_len..][..self.block_len];
        (codes, block % ROW_BLOCKS * BLOCK_ROWS)
    }

    /// All blocks of codes, one after the other.
    pub(crate) fn blocks(&self) -> impl Iterator<Item = &[u16]> {
        self.codes.chunks_exact(self.block_len)
    }

    /// The meaning of the codes.
    pub(crate) fn quantizer(&self) -> &Quantizer {
        &self.quantizer
    }

    /// The bytes that the codes hold.
    pub(crate) fn memory_bytes(&self) -> usize {
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
        for leaf_rows in [5, BLOCK_ROWS, BLOCK_ROWS + 1, 40] {
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
            let state = row(narrow, query);
            let tree = KdTree::new(space.clone(), points.clone(), BLOCK_ROWS).unwrap();
            for radius in points.iter().map(|point| space.distance(point.row, &state)) {
                let near = |row: &[f64]| space.distance(row, &state) <= radius;
                let expected = points.iter().filter(|point| near(point.row)).count();
                let found = tree
                    .search(&state, &Search::nearest_r(radius))
                    .unwrap()
                    .neighbors;
                assert_eq!(found.len(), expected, "{space} {radius}");
            }
        }
    }

    #[test]
    fn rows_are_quantized_where_that_pays() {
        let quantized = |space: &str, number: f64| {
            let space: Space = space.parse().unwrap();
            let (mut points, width) = (Points::new(space.coordinates()), space.coordinates());
            points.push(1, 0, 1, &vec![0.0; width]);
            points.push(2, 0, 1, &vec![number; width]);
            let mut blocks = Blocks::with_capacity(width, 2);
            for point in points.iter() {
                blocks.write(point.id as usize - 1, point.row);
            }
            QuantizedRows::where_they_pay(&space, &points, &blocks).is_some()
        };
        let wide = Kernels::default().are_wide();
        assert_eq!([quantized("R9", 1.0), quantized("R9", 1e90)], [wide; 2]);
        assert!(!quantized("R8", 1.0));
        // Keys in steps would be out of range.
        assert!(!quantized("R9", 1e140) && !quantized("R9", 1e-140) && !quantized("R9:1e201", 1.0));
        assert!(!quantized("R9", 0.0));
    }
}
