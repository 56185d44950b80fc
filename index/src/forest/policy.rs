//! The merge policy: a pure function of the sizes of the levels.
//!
//! The logarithmic method (Bentley and Saxe): levels double in size, and two of a size carry into a larger one like
//! digits. A level is in the tier ⌊log₂(live rows / [`MIN_ROWS`])⌋, and at rest each tier holds at most one level. A
//! carry includes levels up to [`MAX_CARRY_RATIO`] times as large as itself, because a full growing tree is large
//! already. With 8,192 points in a new level, a point is rebuilt 8 times in a million and 12 times in ten million, and
//! a search visits 2.2 and 3.0 levels on average. With a ratio of three these would be 6 and 9 times, and 2.5 and 3.6
//! levels.

/// Levels of fewer rows count as equally small: searching one costs as much as scanning it.
pub(super) const MIN_ROWS: usize = 128;

/// The sizes of a level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    /// Points stored, dead ones included.
    pub(super) rows: usize,
    /// Points dead at the head.
    pub(super) dead: usize,
    /// True if a merge has built its tree.
    pub(super) packed: bool,
    /// True if a running merge has the level.
    pub(super) busy: bool,
}

impl Shape {
    fn live(&self) -> usize {
        self.rows - self.dead
    }

    fn tier(&self) -> u32 {
        (self.live() / MIN_ROWS).checked_ilog2().unwrap_or(0)
    }
}

/// The next merge, as indices into `shapes`, or None if no merge is due. In this order: the lowest tier that holds two
/// levels, with its carry; an unpacked level; a level that is more than half dead. No merge makes a level of more than
/// `max_rows`.
pub(super) fn next_merge(shapes: &[Shape], max_rows: usize) -> Option<Vec<usize>> {
    let idle = idle(shapes);
    carry(shapes, &idle, max_rows).or_else(|| {
        let alone = |predicate: fn(&Shape) -> bool| {
            let fits = |shape: &Shape| predicate(shape) && shape.live() <= max_rows;
            idle.iter().copied().find(|&i| fits(&shapes[i]))
        };
        alone(|shape| !shape.packed)
            .or_else(|| alone(|shape| shape.dead * 2 > shape.rows))
            .map(|i| vec![i])
    })
}

/// The next merge while writes pause and none is due, on the way to one level: the two smallest levels, with those not
/// much larger. The steps are small, so that little is undone when writes resume. A level is rebuilt only for a share
/// of 1 / [`MIN_GAIN`] of it, or each pause after a few points would rebuild all levels.
pub(super) fn next_while_paused(shapes: &[Shape], max_rows: usize) -> Option<Vec<usize>> {
    let mut idle = idle(shapes);
    while let Some((&largest, others)) = idle.split_last() {
        let joins: usize = others.iter().map(|&i| shapes[i].live()).sum();
        if joins + shapes[largest].dead >= shapes[largest].live() / MIN_GAIN {
            break;
        }
        idle.pop();
    }
    gather(shapes, &idle, 2, max_rows)
}

/// A pause rebuilds a level if the points that join it, and its dead ones, are at least one in this many of it. A merge
/// only saves the search of a much smaller level, which begins with the bound found in the larger one.
const MIN_GAIN: usize = 16;

/// The levels without a running merge, by ascending size.
fn idle(shapes: &[Shape]) -> Vec<usize> {
    let mut idle: Vec<usize> = (0..shapes.len()).filter(|&i| !shapes[i].busy).collect();
    idle.sort_by_key(|&i| shapes[i].live());
    idle
}

/// The levels of the lowest tier that holds more than one, and those that join them. `idle` is by ascending size.
fn carry(shapes: &[Shape], idle: &[usize], max_rows: usize) -> Option<Vec<usize>> {
    let tier = |i: usize| shapes[i].tier();
    let start = (1..idle.len()).find(|&at| tier(idle[at - 1]) == tier(idle[at]))? - 1;
    let idle = &idle[start..];
    let share = idle.iter().take_while(|&&i| tier(i) == tier(idle[0]));
    gather(shapes, idle, share.count(), max_rows)
}

/// The greatest ratio of a level to the carry that includes it.
const MAX_CARRY_RATIO: usize = 6;

/// The `first` levels of `idle`, and each next one of at most [`MAX_CARRY_RATIO`] times their sum. None if these are
/// fewer than two. `idle` is by ascending size.
fn gather(shapes: &[Shape], idle: &[usize], first: usize, max_rows: usize) -> Option<Vec<usize>> {
    let mut total = 0;
    let mut taken = Vec::new();
    for &i in idle {
        let live = shapes[i].live();
        let joins = taken.len() < first || live <= MAX_CARRY_RATIO * total;
        if !joins || total + live > max_rows {
            break;
        }
        total += live;
        taken.push(i);
    }
    (taken.len() >= 2).then_some(taken)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn level(rows: usize) -> Shape {
        Shape {
            rows,
            dead: 0,
            packed: true,
            busy: false,
        }
    }

    fn pick(shapes: &[Shape]) -> Option<Vec<usize>> {
        next_merge(shapes, usize::MAX)
    }

    #[test]
    fn levels_of_different_tiers_rest() {
        assert_eq!(pick(&[level(1000), level(300), level(100)]), None);
        assert_eq!(pick(&[]), None);
    }

    #[test]
    fn a_carry_goes_on_to_levels_that_are_not_much_larger() {
        let shapes = [
            level(30_000),
            level(3600),
            level(600),
            level(100),
            level(100),
        ];
        assert_eq!(pick(&shapes), Some(vec![3, 4, 2, 1]));
    }

    #[test]
    fn busy_levels_are_left_alone() {
        let busy = Shape {
            busy: true,
            ..level(100)
        };
        assert_eq!(pick(&[level(100), busy]), None);
        assert_eq!(pick(&[level(100), busy, level(100)]), Some(vec![0, 2]));
    }

    #[test]
    fn an_unpacked_level_is_packed_once_nothing_carries() {
        let unpacked = Shape {
            packed: false,
            ..level(10_000)
        };
        assert_eq!(pick(&[unpacked, level(100)]), Some(vec![0]));
        assert_eq!(pick(&[unpacked, level(100), level(100)]), Some(vec![1, 2]));
    }

    #[test]
    fn a_level_more_than_half_dead_is_rewritten() {
        let half = Shape {
            dead: 500,
            ..level(1000)
        };
        assert_eq!(pick(&[half]), None);
        assert_eq!(pick(&[Shape { dead: 501, ..half }]), Some(vec![0]));
    }

    #[test]
    fn no_level_outgrows_its_slots() {
        assert_eq!(next_merge(&[level(600), level(600)], 1000), None);
        let shapes = [level(600), level(300), level(300)];
        assert_eq!(next_merge(&shapes, 1000), Some(vec![1, 2]));
        let unpacked = Shape {
            packed: false,
            ..level(600)
        };
        assert_eq!(next_merge(&[unpacked], 600), Some(vec![0]));
        assert_eq!(next_merge(&[unpacked], 599), None);
    }

    #[test]
    fn while_no_one_writes_levels_of_like_size_become_one() {
        let mut shapes = vec![level(100_000), level(13_000), level(2000), level(100)];
        let mut steps = Vec::new();
        while let Some(merge) = next_while_paused(&shapes, usize::MAX) {
            let rows = merge.iter().map(|&i| shapes[i].rows).sum();
            steps.push(rows);
            let mut at = 0..;
            shapes.retain(|_| at.next().is_some_and(|at| !merge.contains(&at)));
            shapes.push(level(rows));
        }
        assert_eq!(steps, [2100, 15_100, 115_100]);
        let busy = Shape {
            busy: true,
            ..level(100)
        };
        assert_eq!(next_while_paused(&[level(200), busy], usize::MAX), None);
    }

    #[test]
    fn a_pause_rebuilds_a_level_for_a_sixteenth_of_it() {
        let quiet = |shapes: &[Shape]| next_while_paused(shapes, usize::MAX);
        assert_eq!(quiet(&[level(16_000), level(999)]), None);
        assert_eq!(quiet(&[level(16_000), level(1000)]), Some(vec![1, 0]));
        // Small levels are merged all the same, and may add up to enough.
        let shapes = [level(160_000), level(3000), level(200)];
        assert_eq!(quiet(&shapes), Some(vec![2, 1]));
        let shapes = [level(16_000), level(700), level(300)];
        assert_eq!(quiet(&shapes), Some(vec![2, 1]));
        // Below the largest level as well.
        assert_eq!(quiet(&[level(1 << 20), level(60_000), level(128)]), None);
        let half_dead = Shape {
            dead: 1000,
            ..level(17_000)
        };
        assert_eq!(quiet(&[half_dead, level(128)]), Some(vec![1, 0]));
    }

    /// At rest after any number of full growing trees there are few levels, and few rebuilds of a row have led to them.
    #[test]
    fn single_inserts_cost_a_logarithm_of_rebuilds() {
        let mut shapes: Vec<Shape> = Vec::new();
        let mut rebuilt = 0;
        for sealed in 1..=1024usize {
            shapes.push(level(MIN_ROWS));
            while let Some(merge) = pick(&shapes) {
                let rows = merge.iter().map(|&i| shapes[i].rows).sum();
                rebuilt += rows;
                let mut at = 0;
                shapes.retain(|_| {
                    at += 1;
                    !merge.contains(&(at - 1))
                });
                shapes.push(level(rows));
            }
            assert!(
                shapes.len() as u32 <= 2 + sealed.ilog2() * 5 / 8,
                "{sealed}: {shapes:?}"
            );
        }
        assert!(rebuilt <= MIN_ROWS * 1024 * 13, "{rebuilt}");
    }
}
