//! Where a worker's neighbours come from: one tree of the two.

use wayfold::{Client, Include, Neighbor, Replica, Search};

use super::{
    super::{error::PlanningError, options::Kind},
    store::Store,
};

/// The vertex that is nearest to a state.
pub struct Nearest {
    /// Its id and distance.
    pub neighbor: Neighbor,
    /// Its state.
    pub state: Vec<f64>,
    /// The revision that was searched.
    pub revision: u64,
}

/// Where they come from.
pub enum Source {
    /// The server, in a call.
    Server,
    /// Replicas in the worker's own process, one for each tree, as new as they happen to be.
    Replicas([Replica; 2]),
}

impl Source {
    /// Opens one of this kind.
    pub async fn open(client: &Client, store: &Store, kind: Kind) -> Result<Source, PlanningError> {
        if kind == Kind::Server {
            return Ok(Source::Server);
        }
        let start = client.replica(store.index(0).name()).await?;
        let goal = match store.together().len() {
            1 => start.clone(),
            _ => client.replica(store.index(1).name()).await?,
        };
        Ok(Source::Replicas([start, goal]))
    }

    /// The vertex of a tree that is nearest to each state; none where the tree has none.
    pub async fn nearest(
        &self,
        store: &Store,
        tree: usize,
        states: &[Vec<f64>],
    ) -> Result<Vec<Option<Nearest>>, PlanningError> {
        let filter = store.filter(tree);
        match self {
            Source::Server => {
                let include = Include {
                    states: true,
                    ..Include::default()
                };
                let found = store.index(tree).knn(states).filter(filter);
                let found = found.include(include).await?;
                let nearest = found.rows().enumerate().map(|(at, row)| {
                    let (id, distance) = row.iter().next()?;
                    Some(Nearest {
                        neighbor: Neighbor { distance, id },
                        state: row.state(0)?.to_vec(),
                        revision: found.revision_of(at),
                    })
                });
                Ok(nearest.collect())
            }
            Source::Replicas(replicas) => {
                let view = replicas[tree].view()?;
                let search = Search {
                    filter,
                    ..Search::nearest_k(1)
                };
                let nearest = |state: &Vec<f64>| {
                    let found = view.search(state, &search)?;
                    Ok(found.neighbors.first().and_then(|&neighbor| {
                        Some(Nearest {
                            neighbor,
                            state: view.get(neighbor.id)?.row.to_vec(),
                            revision: found.revision,
                        })
                    }))
                };
                states.iter().map(nearest).collect()
            }
        }
    }
}
