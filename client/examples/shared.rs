//! A roadmap that several processes build together. Each has a copy of the index, so no search waits for the network.
//!
//!     cargo run --release                         # the server
//!     cargo run --release --example shared        # in two terminals at once; WAYFOLD_SERVER names a server elsewhere

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    error::Error,
    process,
    time::Duration,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Index, InsertOptions, Neighbor, Search};

/// The number of milestones of each process.
const MILESTONES: usize = 200;
/// Milestones are at least `SPACING` apart if the copy knows both, and connected within `RADIUS`.
const SPACING: f64 = 0.1;
const RADIUS: f64 = 1.0;

fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    let uri = uri.as_deref().unwrap_or("http://127.0.0.1:50051");
    let roadmap = shared(uri, process::id().into())?;
    let edges: usize = roadmap.values().map(BTreeSet::len).sum();
    println!("{} milestones with {edges} edges", roadmap.len());
    Ok(())
}

type Roadmap = BTreeMap<u64, BTreeSet<u64>>;

/// Returns the milestones of this process, each with the earlier ones of all processes within the radius.
pub fn shared(uri: &str, seed: u64) -> Result<Roadmap, Box<dyn Error>> {
    let index = Index::shared(uri, "roadmap").create(&"R2".parse()?);
    let index = index.open()?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut own = Roadmap::new();
    while own.len() < MILESTONES {
        let state = random.random::<[f64; 2]>().map(|x| 10.0 * x);
        let nearest = index.nearest(state)?;
        if nearest.is_some_and(|nearest| nearest.distance < SPACING) {
            continue;
        }
        // The milestone is in the copy at once, and travels to the server in the background.
        let options = InsertOptions::new().neighbors(Search::within(RADIUS));
        let inserted = index.insert_with(state, options)?;
        connect(&mut own, inserted.id, &inserted.neighbors.neighbors);
    }
    // The server has all milestones after this.
    index.flush()?;
    // Milestones of other processes that the server stored first, and that had not reached this copy at the insert. A
    // planner that runs for longer asks for them as it grows, with `meanwhile`, which does not wait.
    loop {
        let news = index.wait_meanwhile(Duration::from_secs(10));
        if news.answers.is_empty() && news.open > 0 {
            return Err("the server does not send its mutations".into());
        }
        for answer in &news.answers {
            connect(&mut own, answer.id, &answer.neighbors);
        }
        if news.open == 0 {
            return Ok(own);
        }
    }
}

/// Adds edges from an own milestone to earlier ones. A planner checks here if each way is free.
fn connect(roadmap: &mut Roadmap, id: u64, earlier: &[Neighbor]) {
    let ids = earlier.iter().map(|neighbor| neighbor.id);
    roadmap.entry(id).or_default().extend(ids);
}
