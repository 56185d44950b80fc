//! A worker: PRM*, batch after batch of milestones, on a roadmap that others extend too.
//!
//! The PRM* of S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 30(7), 2011, in
//! its incremental form: a milestone tries the motions to its k(n) nearest among the n earlier milestones. These depend
//! only on the order of the milestones. So any number of workers build the same roadmap as one worker that draws the
//! same states in that order.
//!
//! The milestones of a batch share the calls: one search, one insert, one update. The cost of the calls is most of the
//! cost of the service, and a batch pays it once. The insert reports an earlier milestone of the batch to a later one,
//! like milestones of other workers.

use std::{collections::HashSet, time::Instant};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Filter, IndexHandle, NeighborSpec, Point, Revision, Scaling, Update};

use super::{
    account::Account,
    milestone::{self, PENDING},
    nearby::{self, Candidate, SCALING, STATES, Source},
    scene::Rooms,
};
use crate::planning::{
    error::PlanningError, pending_call::PendingCall, problem::Problem, sampling,
};

/// A worker that samples, checks and inserts.
pub struct Worker<'a> {
    scene: &'a Rooms,
    index: IndexHandle,
    source: Source,
    number: usize,
    rng: ChaCha8Rng,
    batch: usize,
    min_separation: f64,
    account: Account,
}

/// Free states that are not stored yet. Their motions to the existing milestones are checked.
#[derive(Debug)]
pub struct CheckedStates {
    states: Vec<CheckedState>,
    /// A revision up to which no milestone was missed.
    seen: Revision,
}

#[derive(Debug)]
struct CheckedState {
    state: Vec<f64>,
    /// The nearest of the existing milestones.
    earlier: Vec<Candidate>,
    /// The ids at the ends of the free motions.
    edges: Vec<u64>,
}

/// A stored milestone that may lack edges, and its known candidates.
#[derive(Debug)]
pub struct Pending {
    id: u64,
    state: Vec<f64>,
    /// The nearest milestones at the first search.
    earlier: Vec<Candidate>,
    /// The nearest milestones that were stored after that search and before this one.
    meanwhile: Vec<Candidate>,
    /// The edges that are stored with it.
    stored: Vec<u64>,
}

impl Pending {
    /// A milestone that another worker left pending, without known candidates. None if the point is not a milestone.
    pub fn found(point: Point<'_>) -> Option<Pending> {
        Some(Pending {
            id: point.id,
            state: point.state.to_vec(),
            earlier: Vec::new(),
            meanwhile: Vec::new(),
            stored: milestone::edges(point.payload?)?,
        })
    }
}

impl<'a> Worker<'a> {
    /// Creates worker `number` of those that extend an index. Each draws its own states from the same seed.
    pub fn new(
        scene: &'a Rooms,
        index: IndexHandle,
        source: Source,
        number: usize,
        seed: u64,
    ) -> Worker<'a> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number as u64);
        Worker {
            scene,
            index,
            source,
            number,
            rng,
            batch: 1,
            min_separation: 0.0,
            account: Account::default(),
        }
    }

    /// Sets the number of milestones in one insert while the worker extends the roadmap.
    pub fn batch(mut self, milestones: usize) -> Worker<'a> {
        self.batch = milestones;
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

    /// Makes a free state a milestone with all its edges; returns its id, or None if it is too near to another one.
    pub async fn add(&mut self, state: Vec<f64>) -> Result<Option<u64>, PlanningError> {
        let checked = self.look(vec![state]).await?;
        let pending = self.insert(checked).await?;
        let id = pending.first().map(|pending| pending.id);
        self.complete(pending).await?;
        Ok(id)
    }

    /// The first step: checks the motions of free states to existing milestones, and drops states that are too near to
    /// one.
    pub async fn look(&mut self, states: Vec<Vec<f64>>) -> Result<CheckedStates, PlanningError> {
        let start = Instant::now();
        let (near, seen) = self.source.nearest(&self.index, &states).await?;
        self.account.times.searching += start.elapsed();
        let mut checked = Vec::with_capacity(states.len());
        for (state, mut earlier) in states.into_iter().zip(near) {
            let nearest = earlier.first();
            if nearest.is_some_and(|nearest| nearest.distance < self.min_separation) {
                continue;
            }
            let at_once = nearby::without_spare(earlier.len());
            let edges = self.check(&state, &mut earlier[..at_once]);
            checked.push(CheckedState {
                state,
                earlier,
                edges,
            });
        }
        Ok(CheckedStates {
            states: checked,
            seen,
        })
    }

    /// The second step: stores the states with these edges. The response contains the milestones that arrived
    /// meanwhile.
    pub async fn insert(&mut self, checked: CheckedStates) -> Result<Vec<Pending>, PlanningError> {
        if checked.states.is_empty() {
            return Ok(Vec::new());
        }
        let start = Instant::now();
        let pending = self.insertion(checked).await?;
        self.account.times.waiting += start.elapsed();
        Ok(pending)
    }

    /// The call of the second step, which can run while the worker does something else.
    fn insertion(
        &self,
        checked: CheckedStates,
    ) -> impl Future<Output = Result<Vec<Pending>, PlanningError>> + Send + use<> {
        let meanwhile = Filter::default().since(checked.seen);
        let around = NeighborSpec::k_factor(Scaling::K_FACTOR);
        let around = around.filter(meanwhile).include(STATES);
        let states = checked.states;
        let tag = milestone::tag(self.number) | PENDING;
        let insert = self
            .index
            .insert(states.iter().map(|one| &one.state))
            .tags(vec![tag; states.len()])
            .payloads(states.iter().map(|one| milestone::payload(&one.edges)))
            .min_separation(self.min_separation)
            .neighbors(around);
        async move {
            let inserted = insert.await?;
            let around = inserted.neighbors.iter().flat_map(|near| near.rows());
            let rows = states.into_iter().zip(inserted.outcomes).zip(around);
            let pending = rows.filter_map(|((checked, outcome), meanwhile)| {
                let mut meanwhile = nearby::candidates(meanwhile);
                // The search may have seen a later revision than the one that all states of the batch have seen.
                let earlier: HashSet<u64> = checked.earlier.iter().map(|one| one.id).collect();
                meanwhile.retain(|one| !earlier.contains(&one.id));
                Some(Pending {
                    id: outcome.id()?,
                    state: checked.state,
                    earlier: checked.earlier,
                    meanwhile,
                    stored: checked.edges,
                })
            });
            Ok(pending.collect())
        }
    }

    /// The last step: checks the motions to the milestones that arrived meanwhile, and marks the milestones as
    /// complete. It is idempotent, even if two workers do it at once.
    pub async fn complete(&mut self, pending: Vec<Pending>) -> Result<(), PlanningError> {
        if pending.is_empty() {
            return Ok(());
        }
        let update = self.completion(pending).await?;
        let start = Instant::now();
        update.await?;
        self.account.times.waiting += start.elapsed();
        Ok(())
    }

    /// The call of the last step, after its checks.
    async fn completion(&mut self, pending: Vec<Pending>) -> Result<Update, PlanningError> {
        let ids: Vec<u64> = pending.iter().map(|one| one.id).collect();
        let (mut payloads, mut changed) = (Vec::with_capacity(ids.len()), false);
        for mut one in pending {
            self.account.meanwhile += one.meanwhile.len() as u64;
            let stored = std::mem::take(&mut one.stored);
            let edges = self.edges(one).await?;
            changed |= edges != stored;
            self.account.milestones += 1;
            self.account.edges += edges.len() as u64;
            payloads.push(milestone::payload(&edges));
        }
        let mut update = self.index.update(ids);
        if changed {
            update = update.payloads(payloads);
        }
        Ok(update.tags([0]).tag_mask(PENDING))
    }

    /// All edges of a stored milestone.
    async fn edges(&mut self, pending: Pending) -> Result<Vec<u64>, PlanningError> {
        // Ids are assigned from 0 on and nothing is ever removed, so the id is the number of earlier milestones.
        let before = pending.id as usize;
        let k = SCALING.k(before).unwrap_or(usize::MAX);
        let mut candidates = pending.earlier;
        let enough = candidates.len() >= k;
        candidates.extend(pending.meanwhile);
        if !enough && candidates.len() < before {
            // k(n) has grown with the arrivals, or no candidates were known.
            let start = Instant::now();
            let all = nearby::nearest_before(&self.index, &pending.state, pending.id, k).await?;
            let known = std::mem::replace(&mut candidates, all);
            for candidate in &mut candidates {
                let known = known.iter().find(|known| known.id == candidate.id);
                candidate.free = known.and_then(|known| known.free);
            }
            self.account.times.searching += start.elapsed();
        }
        candidates.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.id.cmp(&b.id)));
        candidates.truncate(k);
        Ok(self.check(&pending.state, &mut candidates))
    }

    /// Checks the unchecked motions; returns the ids at the ends of the free ones, ascending.
    fn check(&mut self, state: &[f64], candidates: &mut [Candidate]) -> Vec<u64> {
        let start = Instant::now();
        for candidate in candidates.iter_mut() {
            let (scene, checks) = (self.scene, &mut self.account.checks);
            candidate
                .free
                .get_or_insert_with(|| scene.is_free_way(state, &candidate.state, checks));
        }
        self.account.times.checking += start.elapsed();
        let free = candidates.iter().filter(|one| one.free == Some(true));
        let mut ids: Vec<u64> = free.map(|candidate| candidate.id).collect();
        ids.sort_unstable();
        ids
    }

    /// Extends the roadmap to the given number of milestones, and reports each batch to `progress`.
    ///
    /// While an insert and an update are under way, the next states are drawn and checked. Their checks do not see the
    /// milestones that are being inserted, but their own insert reports these, like those of other workers.
    pub async fn extend(
        &mut self,
        milestones: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<(), PlanningError> {
        let started = Instant::now();
        let before = self.account.times.total;
        let (mut inserting, mut updating) = (PendingCall::default(), PendingCall::default());
        // This is the known number; other workers may have made more.
        let mut there_are = 0;
        while there_are < milestones && !self.is_in_vain(milestones) {
            let missing = usize::try_from(milestones - there_are).unwrap_or(usize::MAX);
            let drawn = (0..self.batch.min(missing)).map(|_| self.sample());
            let drawn = drawn.collect();
            let next = self.look(drawn).await?;
            let start = Instant::now();
            let pending: Vec<Pending> = inserting.finish().await?.unwrap_or_default();
            self.account.times.waiting += start.elapsed();
            there_are = pending.last().map_or(there_are, |last| last.id + 1);
            // States checked for surplus milestones are dropped.
            if there_are < milestones && !next.states.is_empty() {
                inserting.begin(self.insertion(next));
            }
            if !pending.is_empty() {
                let update = self.completion(pending).await?;
                let start = Instant::now();
                updating.finish().await?;
                self.account.times.waiting += start.elapsed();
                updating.begin(async move { Ok(update.await?) });
            }
            self.account.times.total = before + started.elapsed();
            progress(&self.account)?;
        }
        let start = Instant::now();
        let pending: Vec<Pending> = inserting.finish().await?.unwrap_or_default();
        updating.finish().await?;
        self.account.times.waiting += start.elapsed();
        self.complete(pending).await?;
        self.account.times.total = before + started.elapsed();
        Ok(())
    }

    /// True if the space is practically full at the required separation.
    fn is_in_vain(&self, milestones: u64) -> bool {
        const MAX_DRAWS: u64 = 100;
        self.account.samples > MAX_DRAWS * milestones
    }
}
