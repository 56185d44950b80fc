//! A worker's source of neighbours in one of the two trees.

use wayfold::{Client, Include, Neighbor, Replica, ReplicaSearch as Search};

use super::{
    super::{error::PlanningError, options::Source as Form},
    store::Store,
};

/// The vertex nearest to a state.
pub struct Nearest {
    /// Its id and distance.
    pub neighbor: Neighbor,
    /// Its state.
    pub state: Vec<f64>,
    /// The searched revision.
    pub revision: u64,
}

/// The source of neighbours.
pub enum Source {
    /// The server, in a call.
    Server,
    /// Replicas in the worker's own process, one for each tree. They may be behind the server.
    Replicas([Replica; 2]),
}

impl Source {
    /// Opens a source of this kind.
    pub async fn open(client: &Client, store: &Store, kind: Form) -> Result<Source, PlanningError> {
        if kind != Form::Shared {
            return Ok(Source::Server);
        }
        let start = client.replica(store.index(0).name()).await?;
        let goal = match store.together().len() {
            1 => start.clone(),
            _ => client.replica(store.index(1).name()).await?,
        };
        Ok(Source::Replicas([start, goal]))
    }

    /// The vertex of a tree that is nearest to each state; None if the tree is empty.
    pub async fn nearest(
        &self,
        store: &Store,
        tree: usize,
        states: &[Vec<f64>],
    ) -> Result<Vec<Option<Nearest>>, PlanningError> {
        let filter = store.filter(tree);
        match self {
            Source::Server => {
                let include = Include::none().states();
                let found = store.index(tree).knn(states).filter(filter);
                let found = found.include(include).await?;
                let nearest = found.rows().enumerate().map(|(at, row)| {
                    Some(Nearest {
                        neighbor: row.nearest()?,
                        state: row.state(0)?.to_vec(),
                        revision: found.revision_of(at).number,
                    })
                });
                Ok(nearest.collect())
            }
            Source::Replicas(replicas) => {
                let view = replicas[tree].view()?;
                let search = Search::k(1).filter(filter);
                let nearest = |state: &Vec<f64>| {
                    let found = view.search(state, &search)?;
                    Ok(found.nearest().and_then(|neighbor| {
                        Some(Nearest {
                            neighbor,
                            state: view.get(neighbor.id)?.row.to_vec(),
                            revision: found.revision().number,
                        })
                    }))
                };
                states.iter().map(nearest).collect()
            }
        }
    }
}
