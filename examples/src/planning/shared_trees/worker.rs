//! A worker: RRTConCon, on two trees that others grow too.
//!
//! It connects one tree to a random state as far as that goes, and then the other to where the first has arrived, both by
//! what it finds in the index. Only then it inserts what both have become: its ids are its own, so nobody has to be
//! asked. A batch does so for several random states with the same calls (through replicas, with those of the insert
//! alone), and while that insert is under way the next batch is searched and checked: what a worker misses by it is a few of its
//! own vertices, and of others' no more than it would anyway.

use std::time::Instant;

use bytes::Bytes;
use futures_util::future::try_join_all;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Insert, Neighbor, States};

use super::{
    super::{error::PlanningError, problem::Problem, rrt, sampling, under_way::UnderWay},
    account::Account,
    nearest::{Nearest, Source},
    store::Store,
    vertex,
};

/// One that samples, checks and inserts.
pub struct Worker<'a, P> {
    problem: &'a P,
    store: Store,
    source: Source,
    number: usize,
    rng: ChaCha8Rng,
    batch: usize,
    next_id: u64,
    account: Account,
    asked: Option<Vec<Asked>>,
}

/// A search that was made, and what it found.
#[derive(Clone, Debug)]
pub struct Asked {
    /// Of which tree.
    pub tree: usize,
    /// The nearest vertex to this state.
    pub state: Vec<f64>,
    /// The revision that was searched.
    pub revision: u64,
    /// What was found.
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

/// Where the trees meet.
struct Met {
    state: Vec<f64>,
    vertices: [u64; 2],
}

impl<'a, P: Problem> Worker<'a, P> {
    /// Worker `number` of those that grow the trees of an index; each draws states of its own from the same seed.
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
            asked: None,
        }
    }

    /// Connects the trees to so many random states between two inserts.
    pub fn batch(mut self, states: usize) -> Worker<'a, P> {
        self.batch = states;
        self
    }

    /// Remembers every search from now on.
    pub fn remember(mut self) -> Worker<'a, P> {
        self.asked = Some(Vec::new());
        self
    }

    /// What it has done so far.
    pub fn account(&self) -> Account {
        self.account
    }

    /// The searches that it remembers.
    pub fn into_asked(self) -> Vec<Asked> {
        self.asked.unwrap_or_default()
    }

    /// Grows the trees until they meet, by whomever, or has inserted so many vertices itself; tells `progress` of each
    /// insert. Returns whether they have met.
    pub async fn grow(
        &mut self,
        max_vertices: u64,
        mut progress: impl FnMut(&Account) -> Result<(), PlanningError>,
    ) -> Result<bool, PlanningError> {
        let started = Instant::now();
        let heard = tokio::spawn(self.store.meeting().clone().heard());
        let mut inserting = UnderWay::default();
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
            // It fails only if it panicked.
            heard.await.expect("who listens does not panic")?;
            return Ok(true);
        }
        heard.abort();
        Ok(false)
    }

    /// Waits for the insert that is under way, if there is one.
    async fn finish(&mut self, inserting: &mut UnderWay<()>) -> Result<(), PlanningError> {
        let start = Instant::now();
        inserting.finish().await?;
        self.account.times.waiting += start.elapsed();
        Ok(())
    }

    /// Connects this tree to random states, and the other to where it has arrived. Nothing of it is stored yet.
    async fn connect(&mut self, tree: usize) -> Result<(Vec<Chain>, Option<Met>), PlanningError> {
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
                met.get_or_insert(Met {
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
        if let Some(asked) = &mut self.asked {
            let asked_now = states.iter().zip(&near).filter_map(|(state, near)| {
                let near = near.as_ref()?;
                Some(Asked {
                    tree,
                    state: state.clone(),
                    revision: near.revision,
                    found: near.neighbor,
                })
            });
            asked.extend(asked_now);
        }
        Ok(near)
    }

    /// The vertices on the way from one that is there to `target`, and whether they reach it.
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
            // The same state again, as a vertex that is this worker's to name.
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

    /// The calls that store these, one for each index that becomes more by them.
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

    /// The call that stores these in the index of their tree or trees; none if they have no vertices.
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
