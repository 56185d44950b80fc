//! A worker: PRM*, one milestone after the other, on a roadmap that others extend too.
//!
//! The PRM* of S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 30(7), 2011, in its
//! incremental form: a milestone tries the ways to its k(n) nearest among the n that were there before it. Which these
//! are depends on the order of the milestones alone, so that any number of workers build what one would have built, had it
//! drawn the same states in that order.

use std::time::Instant;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinHandle;
use wayfold_client::{
    Filter, Include, IndexHandle, NeighborQuery, Neighbors, Point, Replica, Scaling, Search, Update,
};

use crate::{
    account::Account,
    milestone::{self, PENDING},
    planning::{error::PlanningError, problem::Problem, sampling},
    scene::Rooms,
};

/// k(n) of PRM*.
pub const SCALING: Scaling = Scaling {
    k_factor: Some(Scaling::K_FACTOR),
    radius_factor: None,
    radius_max: None,
};

/// Where a worker's first candidates come from.
pub enum Source {
    /// The server, in a call.
    Server,
    /// A replica in the worker's own process, as new as it happens to be.
    Replica(Replica),
}

/// One that samples, checks and inserts.
pub struct Worker<'a> {
    scene: &'a Rooms,
    index: IndexHandle,
    source: Source,
    number: usize,
    rng: ChaCha8Rng,
    min_separation: f64,
    account: Account,
}

/// A milestone that is near enough for an edge.
#[derive(Clone, Debug)]
struct Candidate {
    id: u64,
    distance: f64,
    state: Vec<f64>,
    /// Whether the way is free, once it is known.
    free: Option<bool>,
}

/// A free state whose ways to what was there are checked; not stored yet.
#[derive(Debug)]
pub struct Checked {
    state: Vec<f64>,
    /// The nearest of those that were there.
    earlier: Vec<Candidate>,
    /// The revision at which that was so.
    seen: u64,
    /// Where the free ways lead.
    edges: Vec<u64>,
}

/// A stored milestone that may lack edges, and what is known of its candidates.
#[derive(Debug)]
pub struct Pending {
    id: u64,
    revision: u64,
    state: Vec<f64>,
    /// The nearest of those that were there at the first search.
    earlier: Vec<Candidate>,
    /// The nearest of those that came after it, and before the milestone itself.
    meanwhile: Vec<Candidate>,
    /// The edges that are stored with it.
    stored: Vec<u64>,
}

impl Pending {
    /// One that a worker left behind: nothing is known of its candidates. None if that is no milestone.
    pub fn found(point: Point<'_>) -> Option<Pending> {
        Some(Pending {
            id: point.id,
            revision: point.revision,
            state: point.state.to_vec(),
            earlier: Vec::new(),
            meanwhile: Vec::new(),
            stored: milestone::edges(point.payload?)?,
        })
    }
}

impl<'a> Worker<'a> {
    /// Worker `number` of those that extend an index; each draws states of its own from the same seed.
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
            min_separation: 0.0,
            account: Account::default(),
        }
    }

    /// Leaves out what is nearer to a milestone than this.
    pub fn min_separation(mut self, distance: f64) -> Worker<'a> {
        self.min_separation = distance;
        self
    }

    /// What it has done so far.
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
                self.account.checking += start.elapsed();
                return state;
            }
        }
    }

    /// Makes a free state a milestone, with all its edges; returns its id, or none if it is too near to another.
    pub async fn add(&mut self, state: Vec<f64>) -> Result<Option<u64>, PlanningError> {
        let Some(checked) = self.look(state).await? else {
            return Ok(None);
        };
        let Some(pending) = self.insert(checked).await? else {
            return Ok(None);
        };
        let id = pending.id;
        self.complete(pending).await?;
        Ok(Some(id))
    }

    /// The first step: checks the ways to what is there; none if that is too near.
    pub async fn look(&mut self, state: Vec<f64>) -> Result<Option<Checked>, PlanningError> {
        let start = Instant::now();
        let (mut earlier, seen) = self.nearest(&state).await?;
        self.account.searching += start.elapsed();
        let nearest = earlier.first();
        if nearest.is_some_and(|nearest| nearest.distance < self.min_separation) {
            return Ok(None);
        }
        let edges = self.check(&state, &mut earlier);
        Ok(Some(Checked {
            state,
            earlier,
            seen,
            edges,
        }))
    }

    /// The second step: stores the state with these edges, and is told of what arrived meanwhile.
    pub async fn insert(&mut self, checked: Checked) -> Result<Option<Pending>, PlanningError> {
        let start = Instant::now();
        let pending = self.insertion(checked).await?;
        self.account.waiting += start.elapsed();
        Ok(pending)
    }

    /// The call of the second step, which can be under way while the worker does something else.
    fn insertion(
        &self,
        checked: Checked,
    ) -> impl Future<Output = Result<Option<Pending>, PlanningError>> + Send + use<> {
        let around = NeighborQuery {
            scaling: SCALING,
            filter: Filter {
                since_revision: checked.seen,
                ..Filter::default()
            },
            include: STATES,
            ..NeighborQuery::default()
        };
        let insert = self
            .index
            .insert([&checked.state])
            .tags([milestone::tag(self.number) | PENDING])
            .payloads([milestone::payload(&checked.edges)])
            .min_separation(self.min_separation)
            .neighbors(around);
        async move {
            let inserted = insert.await?;
            let Some(id) = inserted.outcomes[0].id() else {
                return Ok(None);
            };
            let meanwhile = inserted.neighbors.as_ref().map(candidates);
            Ok(Some(Pending {
                id,
                revision: inserted.revision,
                state: checked.state,
                earlier: checked.earlier,
                meanwhile: meanwhile.unwrap_or_default(),
                stored: checked.edges,
            }))
        }
    }

    /// The last step: checks the ways to what arrived meanwhile, and says that nothing is missing now. Done twice, also by
    /// two workers at once, it does the same.
    pub async fn complete(&mut self, pending: Pending) -> Result<(), PlanningError> {
        let update = self.completion(pending).await?;
        let start = Instant::now();
        update.await?;
        self.account.waiting += start.elapsed();
        Ok(())
    }

    /// The call of the last step, after its checks.
    async fn completion(&mut self, pending: Pending) -> Result<Update, PlanningError> {
        self.account.meanwhile += pending.meanwhile.len() as u64;
        // Ids are assigned from 0 on and nothing is ever removed: so many milestones were there before.
        let before = pending.id as usize;
        let k = SCALING.k(before).unwrap_or(usize::MAX);
        let mut candidates = pending.earlier;
        let enough = candidates.len() >= k;
        candidates.extend(pending.meanwhile);
        if !enough && candidates.len() < before {
            // k(n) has grown by those that arrived, or nothing was known.
            let start = Instant::now();
            let all = self.nearest_before(&pending.state, pending.revision, k);
            let known = std::mem::replace(&mut candidates, all.await?);
            for candidate in &mut candidates {
                let known = known.iter().find(|known| known.id == candidate.id);
                candidate.free = known.and_then(|known| known.free);
            }
            self.account.searching += start.elapsed();
        }
        candidates.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.id.cmp(&b.id)));
        candidates.truncate(k);
        let edges = self.check(&pending.state, &mut candidates);
        self.account.edges += edges.len() as u64;

        let mut update = self.index.update([pending.id]);
        if edges != pending.stored {
            update = update.payloads([milestone::payload(&edges)]);
        }
        self.account.milestones += 1;
        Ok(update.tags([0]).tag_mask(PENDING))
    }

    /// Checks the ways that are not checked yet; returns where the free ones lead, ascending.
    fn check(&mut self, state: &[f64], candidates: &mut [Candidate]) -> Vec<u64> {
        let start = Instant::now();
        for candidate in candidates.iter_mut() {
            let (scene, checks) = (self.scene, &mut self.account.checks);
            candidate
                .free
                .get_or_insert_with(|| scene.is_free_way(state, &candidate.state, checks));
        }
        self.account.checking += start.elapsed();
        let free = candidates.iter().filter(|one| one.free == Some(true));
        let mut ids: Vec<u64> = free.map(|candidate| candidate.id).collect();
        ids.sort_unstable();
        ids
    }

    /// The k(n) nearest that the source knows, and the revision at which that is so.
    async fn nearest(&self, state: &[f64]) -> Result<(Vec<Candidate>, u64), PlanningError> {
        match &self.source {
            Source::Server => {
                let found = self.index.knn([state]).k_scaled(Scaling::K_FACTOR);
                let found = found.include(STATES).await?;
                Ok((candidates(&found), found.revision()))
            }
            Source::Replica(replica) => {
                let view = replica.view()?;
                let found = view.search_scaled(state, SCALING, &Search::nearest_k(1))?;
                let near = found.neighbors.iter().filter_map(|neighbor| {
                    Some(Candidate {
                        id: neighbor.id,
                        distance: neighbor.distance,
                        state: view.get(neighbor.id)?.row.to_vec(),
                        free: None,
                    })
                });
                Ok((near.collect(), found.revision))
            }
        }
    }

    /// The k nearest of those that were stored before a revision, which the index has reached.
    async fn nearest_before(
        &self,
        state: &[f64],
        revision: u64,
        k: usize,
    ) -> Result<Vec<Candidate>, PlanningError> {
        let mut asked = u32::try_from(2 * k).unwrap_or(u32::MAX);
        loop {
            let include = Include {
                revisions: true,
                ..STATES
            };
            let found = self.index.knn([state]).k(asked).include(include).await?;
            let row = found.row(0);
            let stored = row.revisions.unwrap_or_default().iter();
            let mut near: Vec<Candidate> = candidates(&found)
                .into_iter()
                .zip(stored)
                .filter_map(|(candidate, stored)| (*stored < revision).then_some(candidate))
                .collect();
            if near.len() >= k || row.len() < asked as usize {
                near.truncate(k);
                return Ok(near);
            }
            asked = asked.saturating_mul(2);
        }
    }

    /// Extends the roadmap until it has so many milestones, telling `progress` of each.
    ///
    /// While an insert and an update are under way, the next state is drawn and checked. It does not see the milestone that
    /// is being inserted, but its own insert will tell of it, as of everybody else's.
    pub async fn extend(
        &mut self,
        milestones: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<(), PlanningError> {
        let started = Instant::now();
        let before = self.account.total;
        let (mut inserting, mut updating) = (UnderWay::default(), UnderWay::default());
        let mut enough = false;
        while !enough {
            let state = self.sample();
            let next = self.look(state).await?;
            let start = Instant::now();
            let pending: Option<Pending> = inserting.finish().await?.flatten();
            self.account.waiting += start.elapsed();
            enough = pending.as_ref().is_some_and(|one| one.id + 1 >= milestones)
                || self.is_in_vain(milestones);
            // What was checked for one milestone too many is left.
            if let Some(next) = next.filter(|_| !enough) {
                inserting.begin(self.insertion(next));
            }
            if let Some(pending) = pending {
                let update = self.completion(pending).await?;
                let start = Instant::now();
                updating.finish().await?;
                self.account.waiting += start.elapsed();
                updating.begin(async move { Ok(update.await?) });
            }
            self.account.total = before + started.elapsed();
            progress(&self.account)?;
        }
        let start = Instant::now();
        updating.finish().await?;
        self.account.waiting += start.elapsed();
        self.account.total = before + started.elapsed();
        Ok(())
    }

    /// Whether the space is as good as full at the separation that is wanted.
    fn is_in_vain(&self, milestones: u64) -> bool {
        const TRIES: u64 = 100;
        self.account.samples > TRIES * milestones
    }
}

/// A call that may be under way.
struct UnderWay<T>(Option<JoinHandle<Result<T, PlanningError>>>);

impl<T> Default for UnderWay<T> {
    fn default() -> UnderWay<T> {
        UnderWay(None)
    }
}

impl<T: Send + 'static> UnderWay<T> {
    /// Begins one, on the runtime's threads.
    fn begin(&mut self, call: impl Future<Output = Result<T, PlanningError>> + Send + 'static) {
        self.0 = Some(tokio::spawn(call));
    }

    /// Waits for its end, if there is one.
    async fn finish(&mut self) -> Result<Option<T>, PlanningError> {
        let Some(call) = self.0.take() else {
            return Ok(None);
        };
        // It fails only if the call panicked, or where the runtime ends and nobody waits.
        call.await.expect("a call does not panic").map(Some)
    }
}

const STATES: Include = Include {
    states: true,
    tags: false,
    revisions: false,
    payloads: false,
};

/// The candidates in the answer about one state.
fn candidates(found: &Neighbors) -> Vec<Candidate> {
    let row = found.row(0);
    let near = row.iter().enumerate().filter_map(|(at, (id, distance))| {
        Some(Candidate {
            id,
            distance,
            state: row.state(at)?.to_vec(),
            free: None,
        })
    });
    near.collect()
}
