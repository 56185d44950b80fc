//! The second pass: sampled queries, answered by the forest and by brute force over the stored points.

use wayfold_index::{Linear, Neighbor, Search, Space};

use super::{DOING, Disagreements, Pass};
use crate::service::Error;

/// At most this many times `k` points within a radius are compared.
const MAX_WITHIN_FACTOR: usize = 4;

/// The queries, and the progress of the pass.
pub(super) struct Searches {
    k: usize,
    unasked: Vec<Vec<f64>>,
    queries: Vec<Query>,
    after: Option<u64>,
    /// The number of points measured.
    pub(super) read: u64,
}

struct Query {
    state: Vec<f64>,
    /// The forest's k nearest points.
    nearest: Vec<Neighbor>,
    /// The distance of the last of them.
    radius: f64,
    /// The forest's points within that radius, the nearest of them.
    within: Vec<Neighbor>,
    /// The nearest stored points so far, `MAX_WITHIN_FACTOR * k` at most.
    brute_force: Vec<Neighbor>,
}

/// The most bytes of a query of `k` neighbours: a merge doubles the room of the nearest stored points. Its state is counted
/// twice, because up to half of the states are kept by the sampler too.
pub(super) fn query_bytes(space: &Space, k: usize) -> usize {
    let neighbors = k + 3 * MAX_WITHIN_FACTOR * k;
    let states = 2 * space.coordinates() * size_of::<f64>();
    size_of::<Query>() + neighbors * size_of::<Neighbor>() + states
}

impl Searches {
    /// Before the first query.
    pub(super) fn new(states: Vec<Vec<f64>>, k: usize) -> Self {
        Self {
            k,
            unasked: states,
            queries: Vec::new(),
            after: None,
            read: 0,
        }
    }

    /// Continues to the end (true) or until progress is due (false).
    pub(super) async fn go_on(&mut self, pass: &Pass<'_>) -> Result<bool, Error> {
        let space = pass.published.snapshot.space();
        while let Some(state) = self.unasked.pop() {
            if space.check_canonical(&state).is_err() {
                // A damaged state cannot be searched for; the comparison has reported it.
                continue;
            }
            let query = Query::ask(pass, state, self.k).await?;
            self.queries.push(query);
            if !pass.has_time() {
                return Ok(false);
            }
        }
        if self.queries.is_empty() {
            return Ok(true);
        }
        let mut pace = pass.call.pace(DOING);
        while pass.has_time() {
            let page = pass.page(self.after).await?;
            let Some(last) = page.last() else {
                return Ok(true);
            };
            let space = pass.published.snapshot.space();
            let mut points = Linear::new(space.clone());
            for point in &page {
                // A damaged state has no distance; the comparison has reported it.
                let _ = points.insert(point.indexed());
            }
            for query in &mut self.queries {
                query.measure(&points, MAX_WITHIN_FACTOR * self.k)?;
                pace.step().await?;
            }
            self.after = Some(last.id);
            self.read += page.len() as u64;
        }
        Ok(false)
    }

    /// Compares the forest's answers with brute force, at the end.
    pub(super) fn compare(&self, disagreements: &mut Disagreements) {
        for query in &self.queries {
            let nearest = query.brute_force.iter().take(self.k);
            let within = query
                .brute_force
                .iter()
                .filter(|neighbor| neighbor.distance <= query.radius);
            let question = || format!("the {} nearest of {:?}", self.k, query.state);
            compare(&query.nearest, nearest, question, disagreements);
            let question = || format!("those within {:?} of {:?}", query.radius, query.state);
            compare(&query.within, within, question, disagreements);
        }
    }
}

impl Query {
    /// Searches the forest.
    async fn ask(pass: &Pass<'_>, state: Vec<f64>, k: usize) -> Result<Self, Error> {
        let mut pace = pass.call.pace(DOING);
        let mut search = Search {
            until: pass.call.deadline,
            ..Search::nearest_k(k)
        };
        let nearest = pass.published.snapshot.search(&state, &search)?;
        pace.step().await?;
        let radius = nearest.neighbors.last().map_or(0.0, |last| last.distance);
        (search.k, search.radius) = (MAX_WITHIN_FACTOR * k, radius);
        let within = pass.published.snapshot.search(&state, &search)?;
        tokio::task::yield_now().await;
        Ok(Self {
            state,
            nearest: nearest.neighbors,
            radius,
            within: within.neighbors,
            brute_force: Vec::new(),
        })
    }

    /// Merges the nearest of some points into the nearest so far.
    fn measure(&mut self, points: &Linear, keeps: usize) -> Result<(), Error> {
        let mut search = Search::nearest_k(keeps);
        if self.brute_force.len() == keeps
            && let Some(last) = self.brute_force.last()
        {
            search.radius = last.distance;
        }
        let nearest = points.search(&self.state, &search)?.neighbors;
        self.brute_force.extend(nearest);
        self.brute_force.sort_unstable();
        self.brute_force.truncate(keeps);
        Ok(())
    }
}

/// Neighbours are equal in their ids and in the bits of their distances.
fn compare<'a>(
    answer: &[Neighbor],
    brute_force: impl Iterator<Item = &'a Neighbor>,
    question: impl Fn() -> String,
    disagreements: &mut Disagreements,
) {
    let (mut found, mut expected) = (answer.iter(), brute_force);
    loop {
        let (one, other) = (found.next(), expected.next());
        if one != other {
            let question = question();
            let (one, other) = (describe(one), describe(other));
            disagreements
                .add(|| format!("{question}: the answer has {one}, where brute force has {other}"));
        }
        if one != other || one.is_none() {
            return;
        }
    }
}

fn describe(neighbor: Option<&Neighbor>) -> String {
    match neighbor {
        Some(Neighbor { id, distance }) => format!("id {id} at {distance:?}"),
        None => "no more".into(),
    }
}
