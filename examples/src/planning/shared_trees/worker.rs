//! A worker: RRTConCon on two trees that others extend too.
//!
//! It connects one tree towards a random state as far as possible, and then the other tree towards the end of that
//! connection. Both start from vertices found in the index. Only then it inserts the new vertices of both trees, under
//! ids from its own range. A batch does this for several random states with the same calls; with replicas, only the
//! insert is a call. While that insert is under way, the next batch is searched and checked. These searches miss a few
//! of the worker's own vertices, but no more of others' than they would otherwise.

use std::time::Instant;

use bytes::Bytes;
use futures_util::future::try_join_all;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Insert, Neighbor, States};

use super::{
    super::{error::PlanningError, pending_call::PendingCall, problem::Problem, rrt, sampling},
    account::Account,
    nearest::{Nearest, Source},
    store::Store,
    vertex,
};

/// A worker that samples, checks and inserts.
pub struct Worker<'a, P> {
    problem: &'a P,
    store: Store,
    source: Source,
    number: usize,
    rng: ChaCha8Rng,
    batch: usize,
    next_id: u64,
    account: Account,
    searches: Option<Vec<SearchRecord>>,
}

/// A search and its result.
#[derive(Clone, Debug)]
pub struct SearchRecord {
    /// The searched tree.
    pub tree: usize,
    /// The state whose nearest vertex was searched.
    pub state: Vec<f64>,
    /// The searched revision.
    pub revision: u64,
    /// The result.
    pub found: Neighbor,
}

/// New vertices of one tree, each the parent of the next.
struct Chain {
    tree: usize,
    parent: u64,
    first: u64,
    states: States,
}

impl Chain {
    /// The last vertex, and its state.
    fn end(&self) -> Option<(u64, &[f64])> {
        let last = self.states.len().checked_sub(1)?;
        Some((self.first + last as u64, self.states.row(last)))
    }
}

/// The meeting of the trees.
struct TreeConnection {
    state: Vec<f64>,
    vertices: [u64; 2],
}

impl<'a, P: Problem> Worker<'a, P> {
    /// Creates worker `number` of those that extend the trees of an index. Each draws its own states from the same
    /// seed.
    pub fn new(
        problem: &'a P,
        store: Store,
        source: Source,
        number: usize,
        seed: u64,
    ) -> Worker<'a, P> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number as u64);
        Worker {
            problem,
            store,
            source,
            number,
            rng,
            batch: 1,
            next_id: vertex::first_id(number),
            account: Account::default(),
            searches: None,
        }
    }

    /// Sets the number of random states to which the trees are connected between two inserts.
    pub fn batch(mut self, states: usize) -> Worker<'a, P> {
        self.batch = states;
        self
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
    /// vertices. Reports each insert to `progress`. Returns true if they have met.
    pub async fn grow(
        &mut self,
        max_vertices: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<bool, PlanningError> {
        let started = Instant::now();
        let heard = tokio::spawn(self.store.meeting().clone().heard());
        let mut inserting = PendingCall::default();
        // Half of the workers begin with the other tree.
        let mut growing = self.number % 2;
        while !heard.is_finished() && self.account.vertices < max_vertices {
            let (chains, met) = self.connect(growing).await?;
            self.finish(&mut inserting).await?;
            let inserts = self.insertions(&chains);
            if !inserts.is_empty() {
                let calls = inserts.into_iter().map(IntoFuture::into_future);
                inserting.begin(async move { Ok(try_join_all(calls).await.map(drop)?) });
            }
            if let Some(met) = met {
                self.finish(&mut inserting).await?;
                self.store
                    .meeting()
                    .announce(&met.state, met.vertices)
                    .await?;
                heard.abort();
                self.account.times.total = started.elapsed();
                return Ok(true);
            }
            growing = 1 - growing;
            self.account.times.total = started.elapsed();
            progress(&self.account)?;
        }
        self.finish(&mut inserting).await?;
        self.account.times.total = started.elapsed();
        if heard.is_finished() {
            // The join fails only if the task panicked.
            heard.await.expect("who listens does not panic")?;
            return Ok(true);
        }
        heard.abort();
        Ok(false)
    }

    /// Waits for the insert that is under way, if there is one.
    async fn finish(&mut self, inserting: &mut PendingCall<()>) -> Result<(), PlanningError> {
        let start = Instant::now();
        inserting.finish().await?;
        self.account.times.waiting += start.elapsed();
        Ok(())
    }

    /// Connects this tree to random states, and the other one to the ends of these connections. Nothing is stored yet.
    async fn connect(
        &mut self,
        tree: usize,
    ) -> Result<(Vec<Chain>, Option<TreeConnection>), PlanningError> {
        let start = Instant::now();
        let (space, bounds) = (self.problem.space(), self.problem.bounds());
        let random = (0..self.batch).map(|_| sampling::uniform(space, bounds, &mut self.rng));
        let random: Vec<Vec<f64>> = random.collect();
        self.account.samples += random.len() as u64;
        self.account.times.checking += start.elapsed();

        let near = self.nearest(tree, &random).await?;
        let (mut chains, mut targets) = (Vec::new(), Vec::new());
        for (near, target) in near.iter().flatten().zip(&random) {
            let (chain, _) = self.advance(tree, near, target)?;
            if let Some((_, end)) = chain.end() {
                targets.push(end.to_vec());
                chains.push(chain);
            }
        }
        if chains.is_empty() {
            return Ok((chains, None));
        }
        let other = 1 - tree;
        let near = self.nearest(other, &targets).await?;
        let mut met = None;
        for (at, (near, target)) in near.iter().zip(targets).enumerate() {
            let Some(near) = near else { continue };
            let (chain, reached) = self.advance(other, near, &target)?;
            if let (true, Some((own, _)), Some((end, _))) = (reached, chains[at].end(), chain.end())
            {
                let vertices = if tree == 0 { [own, end] } else { [end, own] };
                met.get_or_insert(TreeConnection {
                    state: target,
                    vertices,
                });
            }
            chains.push(chain);
        }
        Ok((chains, met))
    }

    async fn nearest(
        &mut self,
        tree: usize,
        states: &[Vec<f64>],
    ) -> Result<Vec<Option<Nearest>>, PlanningError> {
        let start = Instant::now();
        let near = self.source.nearest(&self.store, tree, states).await?;
        self.account.times.searching += start.elapsed();
        if let Some(searches) = &mut self.searches {
            let new_searches = states.iter().zip(&near).filter_map(|(state, near)| {
                let near = near.as_ref()?;
                Some(SearchRecord {
                    tree,
                    state: state.clone(),
                    revision: near.revision,
                    found: near.neighbor,
                })
            });
            searches.extend(new_searches);
        }
        Ok(near)
    }

    /// The new vertices on the motion from an existing one to `target`; true if they reach it.
    fn advance(
        &mut self,
        tree: usize,
        near: &Nearest,
        target: &[f64],
    ) -> Result<(Chain, bool), PlanningError> {
        let start = Instant::now();
        let (problem, checks) = (self.problem, &mut self.account.checks);
        let distance = near.neighbor.distance;
        let (mut states, reached) = rrt::advance(problem, &near.state, target, distance, checks)?;
        if distance == 0.0 {
            // The same state as a new vertex, with an id of this worker.
            states.push(target)?;
        }
        self.account.times.checking += start.elapsed();
        let first = self.next_id;
        self.next_id += states.len() as u64;
        let chain = Chain {
            tree,
            parent: near.neighbor.id,
            first,
            states,
        };
        Ok((chain, reached))
    }

    /// The calls that store these vertices, one for each index that gets any.
    fn insertions(&mut self, chains: &[Chain]) -> Vec<Insert> {
        let together = self.store.together().iter();
        let inserts = together.filter_map(|trees| {
            let own = chains.iter().filter(|chain| trees.contains(&chain.tree));
            self.insertion(own.collect())
        });
        let inserts: Vec<Insert> = inserts.collect();
        let vertices = chains.iter().map(|chain| chain.states.len() as u64);
        self.account.vertices += vertices.sum::<u64>();
        self.account.inserts += inserts.len() as u64;
        inserts
    }

    /// The call that stores these vertices in the index of their tree or trees; None if there are none.
    fn insertion(&self, chains: Vec<&Chain>) -> Option<Insert> {
        let (mut ids, mut tags, mut parents): (Vec<u64>, Vec<u64>, Vec<Bytes>) = Default::default();
        for chain in &chains {
            let mut parent = chain.parent;
            for id in (chain.first..).take(chain.states.len()) {
                ids.push(id);
                tags.push(vertex::tag(chain.tree, self.number));
                parents.push(vertex::payload(parent));
                parent = id;
            }
        }
        if ids.is_empty() {
            return None;
        }
        let index = self.store.index(chains.first()?.tree);
        let states = chains.iter().flat_map(|chain| &chain.states);
        let insert = index.insert(states).ids(ids).tags(tags);
        Some(insert.payloads(parents))
    }
}
