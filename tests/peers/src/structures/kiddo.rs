//! The crate kiddo: its immutable and its mutable tree, with the parameters that it recommends, in Euclidean charts.
//!
//! The search of an image is bounded by the answers so far. The crate's own periodic boundaries are not used: they list
//! all images first and search each without a bound. That was slower in SE2 and SO2^6. Storing q and −q,
//! instead of searching from both, took as long in SO3. The crate's feature `simd` needs a nightly compiler; its
//! kernels for leaves do not, and are on.

use std::num::NonZeroUsize;

use ::kiddo::{ImmutableKdTree, MutableKdTree, SquaredEuclidean};

use super::Structure;
use crate::{chart::Chart, data::Rows};

type Metric = SquaredEuclidean<f64>;

/// True if a tree of this many coordinates is compiled in.
pub fn has_width(coordinates: usize) -> bool {
    matches!(coordinates, 3 | 4 | 6 | 12 | 30)
}

/// An immutable tree of these rows.
///
/// # Panics
/// If its width is none of those that are compiled in.
pub fn built(chart: Chart, rows: &Rows) -> Box<dyn Structure> {
    match chart.width() {
        3 => Box::new(Built::<3>::new(chart, rows)),
        4 => Box::new(Built::<4>::new(chart, rows)),
        6 => Box::new(Built::<6>::new(chart, rows)),
        12 => Box::new(Built::<12>::new(chart, rows)),
        30 => Box::new(Built::<30>::new(chart, rows)),
        other => unreachable!("no tree of {other} coordinates"),
    }
}

/// An empty mutable tree.
///
/// # Panics
/// Panics where [`built`] does.
pub fn growing(chart: Chart) -> Box<dyn Structure> {
    match chart.width() {
        3 => Box::new(Growing::<3>::new(chart)),
        4 => Box::new(Growing::<4>::new(chart)),
        6 => Box::new(Growing::<6>::new(chart)),
        12 => Box::new(Growing::<12>::new(chart)),
        30 => Box::new(Growing::<30>::new(chart)),
        other => unreachable!("no tree of {other} coordinates"),
    }
}

struct Built<const K: usize> {
    chart: Chart,
    tree: ImmutableKdTree<f64, K>,
    merged: Vec<(f64, u32)>,
}

impl<const K: usize> Built<K> {
    fn new(chart: Chart, rows: &Rows) -> Self {
        let placed: Vec<[f64; K]> = rows.iter().map(|row| place(&chart, row)).collect();
        let tree = ImmutableKdTree::new_from_slice(&placed)
            .expect("finite points, fewer than the crate's limit");
        Built {
            chart,
            tree,
            merged: Vec::new(),
        }
    }
}

struct Growing<const K: usize> {
    chart: Chart,
    tree: MutableKdTree<f64, K>,
    merged: Vec<(f64, u32)>,
}

impl<const K: usize> Growing<K> {
    fn new(chart: Chart) -> Self {
        Growing {
            chart,
            tree: MutableKdTree::default(),
            merged: Vec::new(),
        }
    }
}

fn place<const K: usize>(chart: &Chart, row: &[f64]) -> [f64; K] {
    let mut place = [0.0; K];
    chart.place(row, &mut place);
    place
}

/// The image of a query in the crate's form.
fn array<const K: usize>(image: &[f64]) -> &[f64; K] {
    image.try_into().expect("images have the query's width")
}

/// The two trees are of different types that share no public trait.
macro_rules! searches {
    () => {
        fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
            found.clear();
            let mut at: [f64; K] = place(&self.chart, query);
            let tree = &self.tree;
            let count = NonZeroUsize::new(k).expect("k is 1 or 10");
            if k == 1 {
                let nearest = tree.query(&at).nearest_one::<Metric>().execute();
                let mut item = nearest.item;
                self.chart
                    .images(&mut at, nearest.distance, |image, reach_2| {
                        let query = tree.query(array(image)).nearest_n::<Metric>(count);
                        match query.within(reach_2).execute().first() {
                            Some(nearer) => {
                                item = nearer.item;
                                nearer.distance
                            }
                            None => reach_2,
                        }
                    });
                found.push(item);
                return;
            }
            let nearest = tree.query(&at).nearest_n::<Metric>(count).execute();
            let merged = &mut self.merged;
            merged.clear();
            merged.extend(nearest.iter().map(|near| (near.distance, near.item)));
            let reach_2 = if merged.len() < k {
                f64::INFINITY
            } else {
                merged[k - 1].0
            };
            self.chart.images(&mut at, reach_2, |image, reach_2| {
                let query = tree.query(array(image)).nearest_n::<Metric>(count);
                let nearer = query.within(reach_2).execute();
                if nearer.is_empty() {
                    return reach_2;
                }
                merged.extend(nearer.iter().map(|near| (near.distance, near.item)));
                merged.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
                merged.truncate(k);
                merged[merged.len() - 1].0
            });
            found.extend(merged.iter().map(|near| near.1));
        }

        fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
            found.clear();
            let mut at: [f64; K] = place(&self.chart, query);
            let tree = &self.tree;
            let reach_2 = self.chart.reach_2(radius);
            let near = tree
                .query(&at)
                .within::<Metric>(reach_2)
                .unsorted()
                .execute();
            found.extend(near.iter().map(|near| near.item));
            self.chart.images(&mut at, reach_2, |image, reach_2| {
                let query = tree.query(array(image)).within::<Metric>(reach_2);
                found.extend(query.unsorted().execute().iter().map(|near| near.item));
                reach_2
            });
        }
    };
}

impl<const K: usize> Structure for Built<K> {
    searches!();

    fn insert(&mut self, _: &[f64]) {
        unreachable!("it is immutable");
    }
}

impl<const K: usize> Structure for Growing<K> {
    searches!();

    fn insert(&mut self, row: &[f64]) {
        let id = self.tree.size() as u32;
        self.tree
            .add(&place(&self.chart, row), id)
            .expect("a finite point, within the crate's limit");
    }
}
