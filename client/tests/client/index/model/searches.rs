//! Searches, each compared with brute force.

use rand::{RngExt, seq::IndexedRandom};
use wayfold::{Error, Neighbor, ScaledRadius, Scaling, Search};

use super::{Model, assert_same};

impl Model {
    /// A random search, and the answer of brute force.
    pub(super) fn question(&mut self, row: &[f64]) -> (Search, Vec<Neighbor>) {
        let (n, dimension) = (self.points.len(), self.index.space().dimension());
        let k = self.rng.random_range(1..30);
        let radius = f64::from(self.rng.random_range(0..8)) / 4.0;
        let mut plain = wayfold_index::Search::nearest_k(usize::MAX);
        let mut search = match self.rng.random_range(0..4) {
            0 => {
                plain.k = k as usize;
                Search::k(k)
            }
            1 => {
                plain.radius = radius;
                Search::within(radius)
            }
            2 => {
                (plain.k, plain.radius) = (k as usize, radius);
                Search::k(k).radius(radius)
            }
            _ => {
                let scaling = Scaling {
                    k_factor: Some(1.5),
                    radius_factor: Some(2.0),
                    radius_max: Some(1.5),
                };
                scaling.apply(&mut plain, n, dimension);
                Search::k_factor(1.5).radius(ScaledRadius::new(2.0).max(1.5))
            }
        };
        if self.rng.random_bool(0.3) {
            (plain.filter.tag_mask, plain.filter.tag_value) = (0b1, 0b1);
            search = search.tag(0b1, 0b1);
        }
        if let Some(&(since, changes)) = self.read_revisions.choose(&mut self.rng)
            && self.rng.random_bool(0.3)
        {
            plain.filter.since_revision = changes;
            search = search.since(since);
        }
        let expected = self.points.search(row, &plain).unwrap().neighbors;
        (search, expected)
    }

    pub(super) fn search(&mut self) {
        let state = self.state();
        let row = self.canonical(&state);
        let (search, expected) = self.question(&row);
        let found = self.index.search(&state[..], &search).unwrap();
        assert_same(&found.neighbors, &expected);
        let mut buffer = vec![Neighbor {
            distance: 0.0,
            id: 0,
        }];
        self.index
            .search_into(&state[..], &search, &mut buffer)
            .unwrap();
        assert_same(&buffer, &expected);
        self.read_revisions
            .push((found.read_revision, self.changes));
        let nearest = self
            .points
            .search(&row, &wayfold_index::Search::nearest_k(1));
        let nearest = nearest.unwrap().neighbors.first().copied();
        assert_eq!(self.index.nearest(&state[..]).unwrap(), nearest);
        let all = wayfold_index::Search::nearest_k(usize::MAX);
        let all = self.points.search(&row, &all).unwrap().neighbors;
        let (k, radius) = (self.rng.random_range(1..30), 1.5);
        let nearest = self.index.nearest_k(&state[..], k).unwrap();
        assert_same(&nearest, &all[..all.len().min(k as usize)]);
        let within = all.partition_point(|found| found.distance <= radius);
        let found = self.index.nearest_r(&state[..], radius).unwrap();
        assert_same(&found, &all[..within]);
        let about = Search::k(k).epsilon(0.5);
        let found = self.index.search(&state[..], &about).unwrap().neighbors;
        assert_eq!(found.len(), all.len().min(k as usize));
        let pairs = found.iter().zip(&all);
        for (found, exact) in pairs {
            assert!(
                found.distance <= 1.5 * exact.distance,
                "{found:?}, {exact:?}"
            );
        }
        assert_eq!(self.index.len().unwrap(), self.points.len());
    }

    /// Asks about many states: one search about all, or one each.
    pub(super) fn search_many(&mut self) {
        let states: Vec<Vec<f64>> = (0..5).map(|_| self.state()).collect();
        let asked = states.iter().map(|state| {
            let row = self.canonical(state);
            self.question(&row)
        });
        let (searches, expected): (Vec<_>, Vec<_>) = asked.collect();
        let answered = match self.index.search_each(&states, &searches) {
            Ok(answered) => answered,
            // A remote index answers one search a call.
            Err(Error::Argument { field, .. }) => {
                assert_eq!(field, "searches");
                let pairs = states.iter().zip(&searches);
                pairs
                    .map(|(state, search)| {
                        self.index
                            .search_many([&state[..]], search)
                            .unwrap()
                            .remove(0)
                    })
                    .collect()
            }
            Err(error) => panic!("{error}"),
        };
        assert_eq!(answered.len(), states.len());
        for (found, expected) in answered.iter().zip(expected) {
            assert_same(&found.neighbors, &expected);
            self.read_revisions
                .push((found.read_revision, self.changes));
        }
        let search = &searches[0];
        let of_all = self.index.search_many(&states, search).unwrap();
        for (state, found) in states.iter().zip(of_all) {
            let alone = self.index.search(&state[..], search).unwrap();
            assert_same(&found.neighbors, &alone.neighbors);
        }
    }
}
