//! A worker: PRM*, milestone after milestone, on a roadmap that others extend too.
//!
//! The PRM* of S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 30(7), 2011, in
//! its incremental form: a milestone tries the motions to its k(n) nearest among the n earlier milestones. These depend
//! only on the order of the milestones. So any number of workers build the same roadmap as one worker that draws the
//! same states in that order.
//!
//! A worker does not wait for that order. It inserts a milestone with the motions that it has checked, and goes on. A
//! shared index tells it later how many milestones came before, and which of the nearest it could not see then. A
//! remote index tells it with the insert.

mod completion;

use std::{
    collections::{BTreeMap, HashMap},
    time::Instant,
};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{
    Client, Include, Index, IndexHandle, InsertOptions, Neighbor, NeighborSpec, RetryPolicy,
    Scaling, Search,
};

use super::{
    account::Account,
    milestone::{self, PENDING},
    scene::Rooms,
};
use crate::planning::{error::PlanningError, options::Source, problem::Problem, sampling};

/// A worker that samples, checks and inserts.
pub struct Worker<'a> {
    scene: &'a Rooms,
    index: Index,
    /// True if the index is a copy, which tells an insert's place in the order later.
    is_shared: bool,
    /// The same index, for calls whose answers must be the server's.
    server: IndexHandle,
    number: usize,
    rng: ChaCha8Rng,
    max_pending: usize,
    min_separation: f64,
    /// The states of the milestones that it has met.
    states: HashMap<u64, Vec<f64>>,
    /// Its milestones without a known place in the order, by id.
    unplaced: BTreeMap<u64, UnorderedMilestone>,
    /// The number of its milestones whose place the index cannot tell.
    lost: usize,
    account: Account,
}

/// A free state whose motions to existing milestones are checked.
#[derive(Debug)]
pub struct CheckedState {
    /// The state, in canonical form.
    pub state: Vec<f64>,
    /// For each checked motion the milestone at its end, and whether it is free.
    motions: BTreeMap<u64, bool>,
}

/// A stored milestone that may lack edges.
struct UnorderedMilestone {
    checked: CheckedState,
    /// Its nearest milestones at its insert.
    found: Vec<Neighbor>,
}

impl CheckedState {
    /// The ids at the ends of the free motions, ascending.
    pub fn edges(&self) -> Vec<u64> {
        let free = self.motions.iter().filter(|(_, is_free)| **is_free);
        free.map(|(id, _)| *id).collect()
    }
}

impl<'a> Worker<'a> {
    /// Opens the index of this name on a server, for worker `number` of those that extend it. Each draws its own states
    /// from the same seed.
    pub async fn open(
        scene: &'a Rooms,
        (uri, name): (&str, &str),
        source: Source,
        number: usize,
        seed: u64,
    ) -> Result<Worker<'a>, PlanningError> {
        // The worker waits for a server that is being restarted.
        let client = Client::builder().retry(RetryPolicy::until_deadline());
        let server = client.connect(uri).await?.index(name).await?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number as u64);
        Ok(Worker {
            scene,
            index: source.open(uri, name)?,
            is_shared: source == Source::Shared,
            server,
            number,
            rng,
            max_pending: 1,
            min_separation: 0.0,
            states: HashMap::new(),
            unplaced: BTreeMap::new(),
            lost: 0,
            account: Account::default(),
        })
    }

    /// Sets the number of own milestones without a known place in the order at which the worker waits for one.
    pub fn max_pending(mut self, milestones: usize) -> Worker<'a> {
        self.max_pending = milestones;
        self
    }

    /// Sets the distance to a milestone below which a state is left out.
    pub fn min_separation(mut self, distance: f64) -> Worker<'a> {
        self.min_separation = distance;
        self
    }

    /// Its account so far.
    pub fn account(&self) -> Account {
        self.account
    }

    /// Draws states until one is free.
    pub fn sample(&mut self) -> Vec<f64> {
        let start = Instant::now();
        loop {
            let (space, bounds) = (self.scene.space(), self.scene.bounds());
            let state = sampling::uniform(space, bounds, &mut self.rng);
            self.account.samples += 1;
            self.account.checks += 1;
            if self.scene.is_free(&state) {
                self.account.times.checking += start.elapsed();
                return state;
            }
        }
    }

    /// Makes a free state a milestone with all its edges, which the server has then; returns its id, or None if it is
    /// too near to another one.
    pub async fn add(&mut self, state: Vec<f64>) -> Result<Option<u64>, PlanningError> {
        let Some(checked) = self.look(state)? else {
            return Ok(None);
        };
        let id = self.insert(checked).await?;
        self.finish().await?;
        Ok(id)
    }

    /// The first step: checks the motions of a free state to existing milestones. None if it is too near to one.
    pub fn look(&mut self, mut state: Vec<f64>) -> Result<Option<CheckedState>, PlanningError> {
        let canonical = self.scene.space().canonicalize(&mut state);
        canonical.map_err(|error| wayfold::Error::State { row: 0, error })?;
        let start = Instant::now();
        let search = Search::k_factor(Scaling::K_FACTOR);
        let near = self.index.search(&state[..], &search)?.neighbors;
        self.account.times.searching += start.elapsed();
        let nearest = near.first();
        if nearest.is_some_and(|nearest| nearest.distance < self.min_separation) {
            return Ok(None);
        }
        let mut checked = CheckedState {
            state,
            motions: BTreeMap::new(),
        };
        self.check(&mut checked, &near)?;
        Ok(Some(checked))
    }

    /// The second step: stores a state with the edges that are known. Returns its id; None if it is too near to another
    /// milestone.
    pub async fn insert(&mut self, checked: CheckedState) -> Result<Option<u64>, PlanningError> {
        let start = Instant::now();
        let payload = milestone::payload(&checked.edges());
        let tag = milestone::tag(self.number) | PENDING;
        if self.min_separation > 0.0 {
            return self.insert_apart(checked, tag, payload).await;
        }
        let options = InsertOptions::new().tag(tag).payload(&payload);
        let options = options.neighbors(Search::k_factor(Scaling::K_FACTOR));
        let inserted = self.index.insert_with(&checked.state[..], options)?;
        self.account.times.waiting += start.elapsed();
        let (id, found) = (inserted.id, inserted.neighbors.neighbors);
        self.states.insert(id, checked.state.clone());
        match self.is_shared {
            true => {
                let unplaced = UnorderedMilestone { checked, found };
                self.unplaced.insert(id, unplaced);
            }
            false => self.complete(id, checked, &found).await?,
        }
        Ok(Some(id))
    }

    /// Acts like [`Worker::insert`], but the server decides if the state is too near to a milestone.
    async fn insert_apart(
        &mut self,
        checked: CheckedState,
        tag: u64,
        payload: bytes::Bytes,
    ) -> Result<Option<u64>, PlanningError> {
        let start = Instant::now();
        let around = NeighborSpec::k_factor(Scaling::K_FACTOR);
        let insert = self
            .server
            .insert([&checked.state])
            .tags([tag])
            .payloads([payload])
            .min_separation(self.min_separation)
            .neighbors(around.include(Include::none().states()));
        let inserted = insert.await?;
        self.account.times.waiting += start.elapsed();
        let Some(id) = inserted.outcomes.first().and_then(|outcome| outcome.id()) else {
            return Ok(None);
        };
        self.states.insert(id, checked.state.clone());
        let mut found = Vec::new();
        for row in inserted.neighbors.iter().flat_map(|near| near.rows()) {
            for (at, near) in row.iter().enumerate() {
                let state = row.state(at).unwrap_or_default();
                self.states.entry(near.id).or_insert_with(|| state.to_vec());
                found.push(near);
            }
        }
        self.complete(id, checked, &found).await?;
        Ok(Some(id))
    }

    /// Extends the roadmap to the given number of milestones, and reports each one to `progress`.
    ///
    /// A worker may make milestones beyond that number, at most as many as it may leave without a place in the order.
    pub async fn extend(
        &mut self,
        milestones: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<(), PlanningError> {
        let started = Instant::now();
        let before = self.account.times.total;
        while (self.index.len()? as u64) < milestones && !self.is_in_vain(milestones) {
            let state = self.sample();
            if let Some(checked) = self.look(state)? {
                self.insert(checked).await?;
            }
            let is_full = self.unplaced.len() >= self.max_pending;
            self.settle(is_full).await?;
            self.account.times.total = before + started.elapsed();
            progress(&self.account)?;
        }
        self.finish().await?;
        self.account.times.total = before + started.elapsed();
        Ok(())
    }

    /// True if the space is practically full at the required separation.
    fn is_in_vain(&self, milestones: u64) -> bool {
        const MAX_DRAWS: u64 = 100;
        self.account.samples > MAX_DRAWS * milestones
    }
}
