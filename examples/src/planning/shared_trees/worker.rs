//! A worker: RRTConCon on two trees that others extend too.
//!
//! It connects one tree towards a random state as far as possible, and then the other tree towards the end of that
//! connection, as the planner of one process does (`rrt`). Each vertex is inserted with its parent. A shared index
//! shows it at once and sends it in the background; the vertices of other workers appear in searches as they arrive.

use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Index, InsertOptions, Neighbor, Search, States};

use super::{
    super::{error::PlanningError, options::Source, problem::Problem, rrt, sampling},
    account::Account,
    meeting::Meeting,
    store,
};

/// A worker that samples, checks and inserts.
pub struct Worker<'a, P> {
    problem: &'a P,
    /// The index of each tree.
    indices: [Index; 2],
    meeting: Meeting,
    number: usize,
    rng: ChaCha8Rng,
    account: Account,
    /// The number of own vertices of each tree.
    own: [u64; 2],
    searches: Option<Vec<SearchRecord>>,
}

/// A search and its result.
#[derive(Clone, Debug)]
pub struct SearchRecord {
    /// The searched tree.
    pub tree: usize,
    /// The state whose nearest vertex was searched.
    pub state: Vec<f64>,
    /// The number of vertices that the worker had inserted into the tree before.
    pub own: u64,
    /// The result.
    pub found: Neighbor,
}

/// The end of a connection.
struct End {
    vertex: u64,
    state: Vec<f64>,
    /// True if the connection reached its target.
    reached: bool,
}

impl<'a, P: Problem> Worker<'a, P> {
    /// Opens the trees of this name for worker `number` of those that extend them. Each draws its own states from the
    /// same seed.
    pub fn open(
        problem: &'a P,
        (uri, trees): (&str, &str),
        source: Source,
        number: usize,
        seed: u64,
    ) -> Result<Worker<'a, P>, PlanningError> {
        let [start, goal] = store::names(trees);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number as u64);
        Ok(Worker {
            problem,
            indices: [source.open(uri, &start)?, source.open(uri, &goal)?],
            meeting: Meeting::open(uri, trees, problem.space())?,
            number,
            rng,
            account: Account::default(),
            own: [0, 0],
            searches: None,
        })
    }

    /// Remembers every search from now on.
    pub fn remember(mut self) -> Worker<'a, P> {
        self.searches = Some(Vec::new());
        self
    }

    /// Its account so far.
    pub fn account(&self) -> Account {
        self.account
    }

    /// The remembered searches.
    pub fn into_searches(self) -> Vec<SearchRecord> {
        self.searches.unwrap_or_default()
    }

    /// Extends the trees until any worker makes them meet, or until this worker has inserted the given number of
    /// vertices, and waits until the server has acknowledged these. Reports each connection to `progress`. Returns true
    /// if the trees have met.
    pub fn grow(
        &mut self,
        max_vertices: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<bool, PlanningError> {
        let started = Instant::now();
        // Half of the workers begin with the other tree.
        let mut growing = self.number % 2;
        let mut has_met = self.meeting.has_happened()?;
        while !has_met && self.account.vertices < max_vertices {
            let met = self.connect_both(growing)?;
            self.account.times.total = started.elapsed();
            if let Some((state, vertices)) = met {
                self.flush()?;
                self.meeting.announce(&state, vertices)?;
                return Ok(true);
            }
            progress(&self.account)?;
            growing = 1 - growing;
            has_met = self.meeting.has_happened()?;
        }
        self.account.times.total = started.elapsed();
        self.flush()?;
        Ok(has_met)
    }

    fn flush(&self) -> Result<(), PlanningError> {
        for index in &self.indices {
            index.flush()?;
        }
        Ok(())
    }

    /// Connects this tree to a random state, and the other one to the end of that connection. Returns the state in
    /// which the trees meet, and its vertices, if they do.
    #[expect(clippy::type_complexity, reason = "a state and two ids")]
    fn connect_both(&mut self, tree: usize) -> Result<Option<(Vec<f64>, [u64; 2])>, PlanningError> {
        let start = Instant::now();
        let (space, bounds) = (self.problem.space(), self.problem.bounds());
        let random = sampling::uniform(space, bounds, &mut self.rng);
        self.account.samples += 1;
        self.account.times.checking += start.elapsed();
        let Some(end) = self.connect(tree, &random)? else {
            return Ok(None);
        };
        let met = self.connect(1 - tree, &end.state)?;
        Ok(met.filter(|met| met.reached).map(|met| {
            let vertices = if tree == 0 {
                [end.vertex, met.vertex]
            } else {
                [met.vertex, end.vertex]
            };
            (end.state, vertices)
        }))
    }

    /// Extends a tree from its nearest vertex towards `target`, until it reaches the target or an obstacle; None if no
    /// vertex could be added.
    fn connect(&mut self, tree: usize, target: &[f64]) -> Result<Option<End>, PlanningError> {
        let Some((near, from)) = self.nearest(tree, target)? else {
            return Ok(None);
        };
        let start = Instant::now();
        let (problem, checks) = (self.problem, &mut self.account.checks);
        let (states, reached) = rrt::advance(problem, &from, target, near.distance, checks)?;
        self.account.times.checking += start.elapsed();
        let vertex = self.insert(tree, near.id, &states)?;
        let last = states.len().checked_sub(1).map(|last| states.row(last));
        let state = match last {
            Some(last) => last.to_vec(),
            None if reached => from,
            None => return Ok(None),
        };
        Ok(Some(End {
            vertex,
            state,
            reached,
        }))
    }

    /// The vertex of a tree that is nearest to a state, and its state; None if the tree is empty.
    fn nearest(
        &mut self,
        tree: usize,
        state: &[f64],
    ) -> Result<Option<(Neighbor, Vec<f64>)>, PlanningError> {
        let start = Instant::now();
        let index = &self.indices[tree];
        let answer = index.search(state, &Search::k(1))?;
        let Some(&found) = answer.neighbors.first() else {
            return Ok(None);
        };
        let point = index.get(found.id)?;
        self.account.times.searching += start.elapsed();
        if let Some(searches) = &mut self.searches {
            searches.push(SearchRecord {
                tree,
                state: state.to_vec(),
                own: self.own[tree],
                found,
            });
        }
        Ok(point.map(|point| (found, point.state)))
    }

    /// Stores states as a chain: the first is a child of `parent`, each other one a child of its predecessor. Returns
    /// the last vertex.
    fn insert(
        &mut self,
        tree: usize,
        mut parent: u64,
        states: &States,
    ) -> Result<u64, PlanningError> {
        let start = Instant::now();
        let index = &self.indices[tree];
        let tag = self.number as u64;
        for state in states {
            let payload = parent.to_le_bytes();
            let options = InsertOptions::new().tag(tag).payload(&payload);
            parent = index.insert_with(state, options)?.id;
        }
        let count = states.len() as u64;
        self.own[tree] += count;
        self.account.vertices += count;
        self.account.times.waiting += start.elapsed();
        Ok(parent)
    }
}
