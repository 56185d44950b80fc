//! The measured structures, ours and the peers', behind one trait.

mod brute;
mod cover;
mod foreign;
mod kiddo;
mod mpnn;
mod scan;
mod wayfold;

use wayfold_index::Space;

use crate::{chart::Chart, data::Rows};
pub use foreign::heap_bytes;
use foreign::{ChartedTree, MetricTree, Shape};

/// A structure that holds rows under the ids 0, 1, 2, … in the order of their arrival.
///
/// Answers are only ids: each library has its own measure of distance, and none has to convert it. All methods borrow
/// mutably, so that a structure can keep its buffers from query to query.
pub trait Structure {
    /// The `k` nearest, into `found`.
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>);

    /// All within a radius, into `found`, in any order.
    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>);

    /// Stores one more row. Only a structure that [`Kind::empty`] made can.
    fn insert(&mut self, row: &[f64]);
}

/// The kinds of structures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The forest right after the last of many single inserts.
    Wayfold,
    /// The forest merged into one tree.
    WayfoldRest,
    /// The paper's tree, in our own version.
    Mpnn,
    /// kiddo's immutable tree.
    Kiddo,
    /// kiddo's mutable tree, grown by single inserts.
    KiddoMutable,
    /// nanoflann's static tree.
    Nanoflann,
    /// nanoflann's forest of static trees, grown by single inserts.
    NanoflannDynamic,
    /// ANN's static tree.
    Ann,
    /// OMPL's GNAT, grown by single inserts.
    OmplGnat,
    /// nigh's tree, grown by single inserts. Only a build with `NIGH` has it.
    Nigh,
    /// A scan that bounds the distances of several points at once.
    SimdScan,
    /// smartcore's cover tree.
    CoverTree,
    /// A scan that computes the distance of every point, one after the other.
    Brute,
}

const NO_CHART: &str =
    "it knows Euclidean coordinates alone, and none order products with rotations";

const NO_SUM: &str = "its products add the distances of factors, and this metric does not";

impl Kind {
    /// All, ours first.
    pub const ALL: [Kind; 13] = [
        Kind::Wayfold,
        Kind::WayfoldRest,
        Kind::Mpnn,
        Kind::Kiddo,
        Kind::KiddoMutable,
        Kind::Nanoflann,
        Kind::NanoflannDynamic,
        Kind::Ann,
        Kind::OmplGnat,
        Kind::Nigh,
        Kind::SimdScan,
        Kind::CoverTree,
        Kind::Brute,
    ];

    /// The structures in the paper's tables.
    pub const PAPER: [Kind; 6] = [
        Kind::Wayfold,
        Kind::WayfoldRest,
        Kind::Mpnn,
        Kind::SimdScan,
        Kind::CoverTree,
        Kind::Brute,
    ];

    /// The name in the tables.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Wayfold => "wayfold",
            Kind::WayfoldRest => "wayfold-rest",
            Kind::Mpnn => "mpnn",
            Kind::Kiddo => "kiddo",
            Kind::KiddoMutable => "kiddo-mutable",
            Kind::Nanoflann => "nanoflann",
            Kind::NanoflannDynamic => "nanoflann-dynamic",
            Kind::Ann => "ann",
            Kind::OmplGnat => "ompl-gnat",
            Kind::Nigh => "nigh",
            Kind::SimdScan => "simd-scan",
            Kind::CoverTree => "cover-tree",
            Kind::Brute => "brute",
        }
    }

    /// True if this build has it.
    pub fn is_compiled(self) -> bool {
        cfg!(nigh) || self != Kind::Nigh
    }

    /// True if it only appends, so that the time of an insertion says nothing.
    pub fn appends(self) -> bool {
        matches!(self, Kind::SimdScan | Kind::Brute)
    }

    /// True if it is our index.
    pub fn is_ours(self) -> bool {
        matches!(self, Kind::Wayfold | Kind::WayfoldRest)
    }

    /// True if it answers in the order (distance, id), and so with the same ids as brute force.
    pub fn orders_by_id(self) -> bool {
        self.is_ours() || self == Kind::Mpnn
    }

    /// The reason why it is not measured in this space; None if it is.
    pub fn refuses(self, space: &Space) -> Option<&'static str> {
        match self {
            Kind::Wayfold
            | Kind::WayfoldRest
            | Kind::Mpnn
            | Kind::SimdScan
            | Kind::CoverTree
            | Kind::Brute => None,
            Kind::Kiddo | Kind::KiddoMutable => {
                if Chart::of(space).is_none() {
                    Some(NO_CHART)
                } else if !kiddo::has_width(space.coordinates()) {
                    Some("a tree of so many coordinates is not compiled in")
                } else {
                    None
                }
            }
            Kind::Nanoflann | Kind::NanoflannDynamic | Kind::Ann => {
                Chart::of(space).is_none().then_some(NO_CHART)
            }
            Kind::OmplGnat => Shape::of(space)
                .is_none()
                .then_some("its distance is not compiled in"),
            Kind::Nigh => {
                let is_its = Shape::of(space).is_some_and(|shape| shape.is_of_nigh());
                (!is_its).then_some(NO_SUM)
            }
        }
    }

    /// True if it takes points one by one.
    pub fn grows(self) -> bool {
        match self {
            Kind::Wayfold
            | Kind::KiddoMutable
            | Kind::NanoflannDynamic
            | Kind::OmplGnat
            | Kind::Nigh
            | Kind::SimdScan
            | Kind::Brute => true,
            Kind::WayfoldRest
            | Kind::Mpnn
            | Kind::Kiddo
            | Kind::Nanoflann
            | Kind::Ann
            | Kind::CoverTree => false,
        }
    }

    /// True if it has another way to take all points at once.
    pub fn builds(self) -> bool {
        !self.grows() || self == Kind::OmplGnat
    }

    /// An empty structure that can grow up to `room` points.
    ///
    /// # Panics
    /// If it does not grow, or refuses the space.
    pub fn empty(self, space: &Space, room: usize) -> Box<dyn Structure> {
        match self {
            Kind::Wayfold => Box::new(wayfold::Wayfold::growing(space)),
            Kind::KiddoMutable => kiddo::growing(chart(space)),
            Kind::NanoflannDynamic => Box::new(ChartedTree::nanoflann_dynamic(chart(space), room)),
            Kind::OmplGnat => Box::new(MetricTree::gnat(
                shape(space),
                space.coordinates(),
                &[],
                room,
            )),
            #[cfg(nigh)]
            Kind::Nigh => Box::new(MetricTree::nigh(shape(space), space.coordinates(), room)),
            #[cfg(not(nigh))]
            Kind::Nigh => unreachable!("it is not compiled in"),
            Kind::SimdScan => Box::new(scan::Scan::new(space)),
            Kind::Brute => Box::new(brute::Brute::new(space)),
            Kind::WayfoldRest
            | Kind::Mpnn
            | Kind::Kiddo
            | Kind::Nanoflann
            | Kind::Ann
            | Kind::CoverTree => {
                unreachable!("{} does not grow", self.name())
            }
        }
    }

    /// A structure built from all these rows at once.
    ///
    /// # Panics
    /// If it has no way to take them at once, or refuses the space.
    pub fn built(self, space: &Space, rows: &Rows) -> Box<dyn Structure> {
        match self {
            Kind::WayfoldRest => Box::new(wayfold::Wayfold::resting(space, rows)),
            Kind::Mpnn => Box::new(mpnn::Paper::new(space, rows)),
            Kind::Kiddo => kiddo::built(chart(space), rows),
            Kind::Nanoflann => Box::new(ChartedTree::nanoflann(chart(space), rows)),
            Kind::Ann => Box::new(ChartedTree::ann(chart(space), rows)),
            Kind::OmplGnat => {
                let width = space.coordinates();
                Box::new(MetricTree::gnat(
                    shape(space),
                    width,
                    rows.numbers(),
                    rows.len(),
                ))
            }
            Kind::CoverTree => Box::new(cover::Cover::new(space, rows)),
            Kind::Wayfold
            | Kind::KiddoMutable
            | Kind::NanoflannDynamic
            | Kind::Nigh
            | Kind::SimdScan
            | Kind::Brute => {
                unreachable!("{} takes one point at a time", self.name())
            }
        }
    }

    /// A structure that holds these rows, inserted one by one if it can grow.
    ///
    /// # Panics
    /// If it refuses the space.
    pub fn of(self, space: &Space, rows: &Rows) -> Box<dyn Structure> {
        if !self.grows() {
            return self.built(space, rows);
        }
        let mut grown = self.empty(space, rows.len());
        for row in rows.iter() {
            grown.insert(row);
        }
        grown
    }
}

fn chart(space: &Space) -> Chart {
    Chart::of(space).expect("only spaces that are not refused")
}

fn shape(space: &Space) -> Shape {
    Shape::of(space).expect("only spaces that are not refused")
}

#[cfg(test)]
mod tests {
    use super::Kind;
    use crate::{
        check::Case,
        data::{self, Data},
        problem::Problem,
        spaces::{self, SETTINGS},
    };

    #[test]
    fn nigh_is_measured_in_its_own_metrics_only() -> Result<(), Problem> {
        let mut measured = Vec::new();
        for setting in SETTINGS {
            if Kind::Nigh.refuses(&spaces::parse(setting.text)?).is_none() {
                measured.push(setting.name);
            }
        }
        let own = ["R3", "R6", "R12", "R30", "SO2^3", "SO2^6", "SO3", "SE3-SUM"];
        assert_eq!(measured, own);
        for text in ["R7", "SO3:0.5", "sum(R3, SO3:0.5)"] {
            assert!(
                Kind::Nigh.refuses(&spaces::parse(text)?).is_some(),
                "{text}"
            );
        }
        Ok(())
    }

    #[test]
    fn every_structure_equals_brute_force_in_every_space_and_data() -> Result<(), Problem> {
        for setting in SETTINGS {
            let space = spaces::parse(setting.text)?;
            for data in Data::UNEVEN.into_iter().chain([Data::Uniform]) {
                let (points, queries) = data::generate(&space, data, 3000, 40)?;
                let case = Case::new(setting.name, &space, data, (&points, &queries), 40);
                for kind in Kind::ALL.into_iter().filter(|kind| kind.is_compiled()) {
                    if kind.refuses(&space).is_none() {
                        case.check(kind, kind.of(&space, &points).as_mut())?;
                    }
                    if kind.refuses(&space).is_none() && kind.builds() {
                        case.check(kind, kind.built(&space, &points).as_mut())?;
                    }
                }
            }
        }
        Ok(())
    }
}
