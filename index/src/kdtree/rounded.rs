//! The rows of a tree once more, in half of the memory, where a search is bound by reading them.
//!
//! In many dimensions all points are about equally far away, and a search that has its neighbours still reads most of the
//! rows, only to find that they are farther. That can be told by rounded numbers: a block is read only if one of its points,
//! moved by what rounding may have moved it, is near enough.

use crate::{Factor, Space, blocks::Blocks, kernel::BLOCK};

/// From so many dimensions on rows are read more than boxes.
const LEAST_DIMENSION: usize = 16;

/// With a weight above this, of two points that are nearly the same one may be farther than `f64` can tell.
const MOST_WEIGHT: f64 = 1e200;

/// Blocks of rows, rounded to `f32`.
#[derive(Clone, Debug)]
pub(super) struct Rounded {
    /// Numbers of a block.
    block_len: usize,
    columns: Vec<f32>,
    error: f64,
}

impl Rounded {
    /// The rounded rows of these blocks, in spaces where they help; None if a number is out of range.
    pub(super) fn where_it_helps(space: &Space, blocks: &Blocks) -> Option<Self> {
        let is_heavy = space.parts().iter().any(|part| part.weight > MOST_WEIGHT);
        if space.dimension() < LEAST_DIMENSION || is_heavy {
            return None;
        }
        Self::new(space, blocks)
    }

    /// The rounded rows of these blocks; None if a number is out of range.
    fn new(space: &Space, blocks: &Blocks) -> Option<Self> {
        let columns: Vec<f32> = blocks.numbers().iter().map(|&x| x as f32).collect();
        // The farthest that a point has moved in each coordinate, and no less than what squares lose.
        let mut moved = vec![f64::MIN_POSITIVE.sqrt(); space.coordinates()];
        let both = blocks.numbers().chunks(BLOCK).zip(columns.chunks(BLOCK));
        for (at, (exact, rounded)) in both.enumerate() {
            let most = &mut moved[at % space.coordinates()];
            for (x, &y) in exact.iter().zip(rounded) {
                *most = f64::max(*most, (x - f64::from(y)).abs());
            }
        }
        columns.iter().all(|x| x.is_finite()).then_some(Self {
            block_len: space.coordinates() * BLOCK,
            columns,
            error: error(space, &moved),
        })
    }

    /// A block: of each coordinate `BLOCK` numbers.
    pub(super) fn block(&self, at: usize) -> &[f32] {
        &self.columns[at * self.block_len..][..self.block_len]
    }

    /// No point has moved farther than this, but by its rotations.
    pub(super) fn error(&self) -> f64 {
        self.error
    }

    /// The bytes the columns hold.
    pub(super) fn memory_bytes(&self) -> usize {
        4 * self.columns.capacity()
    }
}

/// How far a state moves whose coordinates move so far each, but for its rotations, whose kernel knows by itself what
/// they lose.
fn error(space: &Space, moved: &[f64]) -> f64 {
    let (mut total, mut sum_2) = (0.0, 0.0);
    for part in space.parts() {
        let moved = &moved[part.offset..][..part.factor.coordinates()];
        sum_2 += part.weight
            * match part.factor {
                Factor::RealVector(_) => moved.iter().map(|d| d * d).sum(),
                // And what the way across the seam may be off by.
                Factor::SO2 { period } => (moved[0] + period * f64::EPSILON).powi(2),
                Factor::SO3 => 0.0,
            };
        if part.ends_group {
            total += space.groups()[part.group].weight * sum_2.sqrt();
            sum_2 = 0.0;
        }
    }
    total * (1.0 + 1e-9)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        Kernels,
        kernel::{
            self, Scale, Set, Task,
            tests::{scene, space},
        },
        space::tests::cases,
    };

    /// The rounded numbers of a block, and which of its points may have a key up to a limit.
    struct Within<'a>(&'a Space, &'a [f64], &'a [f32], f64);

    impl Task for Within<'_> {
        type Output = u32;

        #[inline(always)]
        fn run<S: Set>(self) -> u32 {
            kernel::points::<S, f32>(self.0, self.1, self.2, self.3).1
        }
    }

    /// How far apart states of a space are whose rotations differ by an angle of 1e-3.
    fn small_rotations(space: &Space) -> f64 {
        let rotations = space
            .parts()
            .iter()
            .filter(|part| part.factor == Factor::SO3);
        let scaled = rotations.map(|part| space.groups()[part.group].weight * part.weight.sqrt());
        1e-3 * scaled.sum::<f64>()
    }

    proptest! {
        #![proptest_config(cases(4000))]

        #[test]
        fn no_point_within_reach_is_lost_by_rounding(seed: u64, far in prop_oneof![Just(1.0), Just(1e9), Just(1e37)]) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let space = space(&mut rng);
            let (mut query, mut rows) = scene(&space, BLOCK, &mut rng);
            for row in rows.iter_mut().chain([&mut query]) {
                for part in space.parts() {
                    if let Factor::RealVector(axes) = part.factor {
                        row[part.offset..][..axes].iter_mut().for_each(|x| *x *= far);
                    }
                }
            }
            let mut blocks = Blocks::with_capacity(space.coordinates(), BLOCK);
            for (place, row) in rows.iter().enumerate() {
                blocks.write(place, row);
            }
            let rounded = Rounded::new(&space, &blocks).unwrap();
            let scale = Scale::new(&space);
            let within = |distance: f64, kernels: &Kernels| {
                let limit = scale.loosened(scale.limit(distance), rounded.error());
                kernels.run(Within(&space, &query, rounded.block(0), limit))
            };
            for kernels in Kernels::available() {
                for (lane, row) in rows.iter().enumerate() {
                    let distance = space.distance(&query, row);
                    prop_assert!(within(distance, kernels) >> lane & 1 == 1, "{} {}", space, distance);
                    // What is lost is what rounding may move a point, and what small rotations are worth.
                    let nearer = 0.98 * distance - small_rotations(&space) - 4.0 * rounded.error();
                    prop_assert!(within(nearer, kernels) >> lane & 1 == 0, "{} {}", space, distance);
                }
                prop_assert_eq!(within(-1.0, kernels), 0);
            }
        }
    }

    /// A tree of these numbers in the first coordinate finds all that lie within their distance of a query.
    fn all_are_found(space: &str, number: f64, query: f64) {
        let space: Space = space.parse().unwrap();
        let row = |number: f64| {
            let mut row = vec![0.0; space.coordinates()];
            row[0] = number;
            row
        };
        let mut points = crate::Points::new(space.coordinates());
        for id in 0..40 {
            points.push(id, 0, 1, &row(number));
        }
        let radius = space.distance(&row(number), &row(query));
        let tree = crate::KdTree::new(space.clone(), points, BLOCK);
        let found = tree.search(&row(query), &crate::Search::nearest_r(radius));
        assert_eq!(found.neighbors.len(), 40, "{space}");
    }

    #[test]
    fn nothing_is_lost_where_squares_are_out_of_range() {
        all_are_found("R16:1e5", 1.5e-162, 1e-150);
        all_are_found("R16:1e308", 1e-163, 1e-154);
        all_are_found("sum((R16:1e20), R1)", 1e-162, 1e-154);
        all_are_found("sum((R16:1e300), R1)", 100.1, 13_507.907_929);
    }

    #[test]
    fn numbers_out_of_range_are_not_rounded() {
        let space: Space = "R17".parse().unwrap();
        let mut blocks = Blocks::with_capacity(17, 1);
        blocks.write(0, &[1e39; 17]);
        assert!(Rounded::where_it_helps(&space, &blocks).is_none());
        blocks.write(0, &[1e38; 17]);
        assert!(Rounded::where_it_helps(&space, &blocks).is_some());
    }
}
