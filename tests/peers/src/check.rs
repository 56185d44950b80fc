//! Brute force. Every structure must return its answers before it is timed.

use wayfold_index::{Linear, Neighbor, PointRef, Search, Space};

use crate::{
    data::{Data, Rows},
    problem::Problem,
    structures::{Kind, Structure},
};

/// The number of neighbours that `knn10` requests. A radius is chosen to hold about as many.
pub const NEIGHBORS: usize = 10;

/// The relative tolerance of distances for structures that compute them differently.
const TOLERANCE: f64 = 1e-9;

/// The points and queries of one row of the table, with the correct answers to the first queries.
pub struct Case<'a> {
    /// The space, by name.
    pub name: &'a str,
    /// The space.
    pub space: &'a Space,
    /// The data's name.
    pub data: Data,
    /// The stored points.
    pub points: &'a Rows,
    /// The query states.
    pub queries: &'a Rows,
    /// The radius of `radius` queries.
    pub radius: f64,
    /// The answers of brute force to the first queries: the nearest ones, and those within the radius.
    truth: Vec<(Vec<Neighbor>, Vec<Neighbor>)>,
}

impl<'a> Case<'a> {
    /// Computes the answers to the first `checked` queries by brute force.
    pub fn new(
        name: &'a str,
        space: &'a Space,
        data: Data,
        (points, queries): (&'a Rows, &'a Rows),
        checked: usize,
    ) -> Self {
        let mut linear = Linear::new(space.clone());
        for (id, row) in points.iter().enumerate() {
            linear
                .insert(PointRef {
                    id: id as u64,
                    tag: 0,
                    revision: 1,
                    row,
                })
                .expect("canonical states");
        }
        // This is enough: few radii hold more.
        let search = Search::nearest_k(8 * NEIGHBORS);
        let nearest: Vec<Vec<Neighbor>> = queries
            .iter()
            .take(checked)
            .map(|query| {
                linear
                    .search(query, &search)
                    .expect("canonical states")
                    .neighbors
            })
            .collect();
        let mut tenth: Vec<f64> = nearest
            .iter()
            .map(|near| near[NEIGHBORS - 1].distance)
            .collect();
        tenth.sort_by(f64::total_cmp);
        // The radius is slightly larger, so that no point lies exactly on the sphere, where rounding would decide.
        let radius = tenth[tenth.len() / 2] * (1.0 + 1e-6);
        let truth = nearest
            .into_iter()
            .zip(queries.iter())
            .map(|(mut nearest, query)| {
                let is_whole = nearest.last().is_some_and(|last| last.distance > radius);
                let mut within = if is_whole {
                    nearest.clone()
                } else {
                    linear
                        .search(query, &Search::nearest_r(radius))
                        .expect("canonical states")
                        .neighbors
                };
                within.retain(|near| near.distance <= radius);
                nearest.truncate(NEIGHBORS);
                (nearest, within)
            })
            .collect();
        Case {
            name,
            space,
            data,
            points,
            queries,
            radius,
            truth,
        }
    }

    /// Compares the answers to all queries that brute force has answered.
    ///
    /// # Errors
    /// An answer differs.
    pub fn check(&self, kind: Kind, structure: &mut dyn Structure) -> Result<(), Problem> {
        let mut found = Vec::new();
        for (at, (nearest, within)) in self.truth.iter().enumerate() {
            let query = self.queries.row(at);
            structure.nearest(query, 1, &mut found);
            self.compare(kind, "knn1", at, &nearest[..1], &found)?;
            structure.nearest(query, NEIGHBORS, &mut found);
            self.compare(kind, "knn10", at, nearest, &found)?;
            structure.within(query, self.radius, &mut found);
            self.compare(kind, "radius", at, within, &found)?;
        }
        Ok(())
    }

    fn compare(
        &self,
        kind: Kind,
        op: &'static str,
        at: usize,
        expected: &[Neighbor],
        found: &[u32],
    ) -> Result<(), Problem> {
        let differs = |difference: String| Problem::Mismatch {
            structure: kind.name(),
            space: self.name.to_owned(),
            n: self.points.len(),
            data: self.data.name(),
            op,
            query: at,
            difference,
        };
        if found.len() != expected.len() {
            return Err(differs(format!(
                "{} neighbours instead of {}",
                found.len(),
                expected.len()
            )));
        }
        let query = self.queries.row(at);
        let mut near: Vec<Neighbor> = found
            .iter()
            .map(|&id| Neighbor {
                distance: self.space.distance(query, self.points.row(id as usize)),
                id: u64::from(id),
            })
            .collect();
        if kind.orders_by_id() && near != expected {
            return Err(differs(format!("{near:?} instead of {expected:?}")));
        }
        near.sort_unstable();
        if let Some(twice) = near.windows(2).find(|pair| pair[0].id == pair[1].id) {
            return Err(differs(format!("point {} twice", twice[0].id)));
        }
        let wrong = near.iter().zip(expected).find(|(near, expected)| {
            (near.distance - expected.distance).abs() > TOLERANCE * expected.distance
        });
        match wrong {
            Some((near, expected)) => Err(differs(format!("{near:?} instead of {expected:?}"))),
            None => Ok(()),
        }
    }
}
