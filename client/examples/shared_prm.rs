//! A roadmap (PRM*) that several workers build together: tasks here, which share nothing but the index.
//!
//!     cargo run --release                         # the server
//!     cargo run --release --example shared_prm    # in another terminal; WAYFOLD_SERVER names a server elsewhere

use std::{collections::BTreeMap, env, error::Error};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::task::JoinSet;
use wayfold::{Client, Include, NeighborSpec, Scaling};

/// The number of workers, and the number of milestones of each.
const WORKERS: u64 = 4;
const MILESTONES: usize = 100;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    let roadmap = shared_prm(uri.as_deref().unwrap_or("http://127.0.0.1:50051")).await?;
    println!("{} milestones in all", roadmap.len());
    Ok(())
}

type Roadmap = BTreeMap<u64, Vec<u64>>;

/// Returns the milestones, each with the earlier ones to which the way is free.
pub async fn shared_prm(uri: &str) -> Result<Roadmap, Box<dyn Error>> {
    let client = Client::connect(uri).await?;
    let name = format!("prm-{}", std::process::id());
    client.create_index(&name, &"R2".parse()?).await?;
    let work = (0..WORKERS).map(|seed| work(uri.to_owned(), name.clone(), seed));
    let mut workers: JoinSet<_> = work.collect();
    let mut roadmap = Roadmap::new();
    while let Some(part) = workers.join_next().await {
        let part = part??;
        let edges: Vec<_> = part.values().flatten().collect();
        let to_others = edges.iter().filter(|id| !part.contains_key(id)).count();
        println!("{} edges, {to_others} to milestones of others", edges.len());
        roadmap.extend(part);
    }
    client.delete_index(&name).await?;
    Ok(roadmap)
}

async fn work(uri: String, name: String, seed: u64) -> Result<Roadmap, wayfold::Error> {
    let index = Client::connect(&uri).await?.index(&name).await?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut own = Roadmap::new();
    while own.len() < MILESTONES {
        let state = random.random::<[f64; 2]>().map(|x| 10.0 * x);
        if !is_free_way(state, &state) {
            continue;
        }
        // One call stores the milestone and finds its k(n) nearest of that moment. The later of two milestones finds
        // the earlier one, so no edge is missed, even between workers. The server evaluates k(n): it knows n.
        let near = NeighborSpec::k_factor(Scaling::K_FACTOR).include(Include::none().states());
        let inserted = index.insert([state]).neighbors(near).await?;
        let (Some(id), Some(near)) = (inserted.outcomes[0].id(), inserted.neighbors) else {
            continue;
        };
        let near = near.row(0);
        let states = (0..near.len()).map(|i| near.state(i));
        let free = states.map(|other| other.is_some_and(|other| is_free_way(state, other)));
        let edges = near.ids().zip(free).filter(|&(_, is_free)| is_free);
        own.insert(id, edges.map(|(other, _)| other).collect());
    }
    Ok(own)
}

/// True if the way from `a` to `b` avoids the obstacle, a disc in the middle.
fn is_free_way(a: [f64; 2], b: &[f64]) -> bool {
    (0..=100)
        .map(|percent| f64::from(percent) / 100.0)
        .all(|t| {
            let [x, y] = [0, 1].map(|axis| (1.0 - t) * a[axis] + t * b[axis]);
            (x - 5.0).hypot(y - 5.0) > 3.0
        })
}
