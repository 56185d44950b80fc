//! Which levels to merge next: a pure function of their sizes.
//!
//! The logarithmic method (Bentley and Saxe): levels double in size, and two of a size carry into larger ones like
//! digits. A level falls in the tier ⌊log₂(live rows / [`LEAST_ROWS`])⌋; at rest each tier holds at most one level. A carry
//! takes along what is up to [`GREED`] times as large as itself, since what grows is large already. Where levels begin with
//! 8,192 points, a point is rebuilt 8 times of a million and 12 of ten million, and a search visits 2.2 and 3.0 levels on
//! average; if nothing more than three times as large were taken along, 6 and 9 times, and 2.5 and 3.6 levels.

/// Levels of fewer rows are alike: a search of one costs what a look at each of its points does.
pub(super) const LEAST_ROWS: usize = 128;

/// What the policy needs to know of a level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    /// Points stored, dead ones included.
    pub(super) rows: usize,
    /// Points dead at the head.
    pub(super) dead: usize,
    /// Whether it has its tree yet.
    pub(super) built: bool,
    /// Whether a merge has it already.
    pub(super) busy: bool,
}

impl Shape {
    fn live(&self) -> usize {
        self.rows - self.dead
    }

    fn tier(&self) -> u32 {
        (self.live() / LEAST_ROWS).checked_ilog2().unwrap_or(0)
    }
}

/// The levels to merge into one, by their places in `shapes`, or None if nothing is due. In this order: the lowest
/// tier that holds two levels, with the carry it sets off; a level without its tree; a level more than half dead.
/// No merge makes a level of more than `max_rows`.
pub(super) fn next_merge(shapes: &[Shape], max_rows: usize) -> Option<Vec<usize>> {
    let idle = idle(shapes);
    carry(shapes, &idle, max_rows).or_else(|| {
        let alone = |wanted: fn(&Shape) -> bool| idle.iter().copied().find(|&i| wanted(&shapes[i]));
        alone(|shape| !shape.built)
            .or_else(|| alone(|shape| shape.dead * 2 > shape.rows))
            .map(|i| vec![i])
    })
}

/// What to merge when nothing is due and no one writes, on the way to one level: the least two levels, with what is not
/// much larger. Small steps, so that a writer who comes back finds little undone; and a level only for the sake of
/// [`WORTH`] of it, or each pause after a few points would rebuild them all.
pub(super) fn next_while_quiet(shapes: &[Shape], max_rows: usize) -> Option<Vec<usize>> {
    let mut idle = idle(shapes);
    while let Some((&largest, others)) = idle.split_last() {
        let joins: usize = others.iter().map(|&i| shapes[i].live()).sum();
        if joins + shapes[largest].dead >= shapes[largest].live() / WORTH {
            break;
        }
        idle.pop();
    }
    gather(shapes, &idle, 2, max_rows)
}

/// The part of a level, one in so many, for which it is rebuilt: by what joins it, or by its dead. All that is saved is a
/// search of what is so much smaller, which begins with the bound that the larger one has given it.
const WORTH: usize = 16;

/// The levels that no merge has, by ascending size.
fn idle(shapes: &[Shape]) -> Vec<usize> {
    let mut idle: Vec<usize> = (0..shapes.len()).filter(|&i| !shapes[i].busy).collect();
    idle.sort_by_key(|&i| shapes[i].live());
    idle
}

/// `idle` by ascending size: those that share the lowest tier that more than one has, and what joins them.
fn carry(shapes: &[Shape], idle: &[usize], max_rows: usize) -> Option<Vec<usize>> {
    let tier = |i: usize| shapes[i].tier();
    let start = (1..idle.len()).find(|&at| tier(idle[at - 1]) == tier(idle[at]))? - 1;
    let idle = &idle[start..];
    let share = idle.iter().take_while(|&&i| tier(i) == tier(idle[0]));
    gather(shapes, idle, share.count(), max_rows)
}

/// How much larger than a carry a level may be that it takes along.
const GREED: usize = 6;

/// The `first` of `idle`, which has them by ascending size, and every next one no greater than [`GREED`] times what
/// they amount to. None if that is not at least two.
fn gather(shapes: &[Shape], idle: &[usize], first: usize, max_rows: usize) -> Option<Vec<usize>> {
    let mut total = 0;
    let mut taken = Vec::new();
    for &i in idle {
        let live = shapes[i].live();
        let joins = taken.len() < first || live <= GREED * total;
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
            built: true,
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
    fn a_level_without_its_tree_is_built_once_nothing_carries() {
        let unbuilt = Shape {
            built: false,
            ..level(10_000)
        };
        assert_eq!(pick(&[unbuilt, level(100)]), Some(vec![0]));
        assert_eq!(pick(&[unbuilt, level(100), level(100)]), Some(vec![1, 2]));
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
    }

    #[test]
    fn while_no_one_writes_levels_of_like_size_become_one() {
        let mut shapes = vec![level(100_000), level(13_000), level(2000), level(100)];
        let mut steps = Vec::new();
        while let Some(merge) = next_while_quiet(&shapes, usize::MAX) {
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
        assert_eq!(next_while_quiet(&[level(200), busy], usize::MAX), None);
    }

    #[test]
    fn a_pause_rebuilds_a_level_for_a_sixteenth_of_it() {
        let quiet = |shapes: &[Shape]| next_while_quiet(shapes, usize::MAX);
        assert_eq!(quiet(&[level(16_000), level(999)]), None);
        assert_eq!(quiet(&[level(16_000), level(1000)]), Some(vec![1, 0]));
        // What is small is merged all the same, and may amount to enough.
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

    /// At rest after any number of sealed buffers there are few levels, and few rebuilds of a row have led to them.
    #[test]
    fn single_inserts_cost_a_logarithm_of_rebuilds() {
        let mut shapes: Vec<Shape> = Vec::new();
        let mut rebuilt = 0;
        for sealed in 1..=1024usize {
            shapes.push(level(LEAST_ROWS));
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
        assert!(rebuilt <= LEAST_ROWS * 1024 * 13, "{rebuilt}");
    }
}
