//! A rapidly exploring random tree (RRT) whose nearest neighbours come from the server.
//!
//!     cargo run --release                     # the server
//!     cargo run --release --example rrt       # in another terminal; WAYFOLD_SERVER names a server elsewhere
//!
//! Each search is a call here, which is simple and slow: `wayfold::Index::shared` searches without the network.

use std::{env, error::Error, iter};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::Client;

const START: [f64; 2] = [1.0, 1.0];
const GOAL: [f64; 2] = [9.0, 9.0];
/// The obstacles: discs by centre and radius, in a square of 10 by 10.
const DISCS: [([f64; 2], f64); 3] = [([3.0, 3.0], 1.5), ([7.5, 4.5], 2.0), ([4.0, 7.5], 2.0)];
/// The length of a step of the tree, and the distance between the checked states of a motion.
const STEP: f64 = 0.5;
const RESOLUTION: f64 = 0.05;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    let path = rrt(uri.as_deref().unwrap_or("http://127.0.0.1:50051"), 1).await?;
    for [x, y] in path {
        println!("{x:.2} {y:.2}");
    }
    Ok(())
}

/// Returns a path from the start to the goal.
pub async fn rrt(uri: &str, seed: u64) -> Result<Vec<[f64; 2]>, Box<dyn Error>> {
    let client = Client::connect(uri).await?;
    let name = format!("rrt-{}", std::process::id());
    let tree = client.create_index(&name, &"R2".parse()?).await?;
    tree.insert([START]).ids([0]).await?;
    // The index holds the states and finds the nearest. The tree's edges are the planner's: point i is the state of
    // node i.
    let mut nodes = vec![(START, None)];
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    while nodes[nodes.len() - 1].0 != GOAL {
        let target = match random.random_bool(0.05) {
            true => GOAL,
            false => random.random::<[f64; 2]>().map(|x| 10.0 * x),
        };
        let found = tree.knn([target]).k(1).await?;
        let nearest = found.row(0).nearest().ok_or("the tree is empty")?;
        let (parent, from) = (nearest.id as usize, nodes[nearest.id as usize].0);
        let to = between(from, target, (STEP / nearest.distance).min(1.0));
        if is_free_way(from, to) {
            tree.insert([to]).ids([nodes.len() as u64]).await?;
            nodes.push((to, Some(parent)));
        }
    }
    println!("a tree of {} nodes has the path", nodes.len());
    client.delete_index(&name).await?;
    let to_root = iter::successors(Some(nodes.len() - 1), |&node| nodes[node].1);
    let mut path: Vec<[f64; 2]> = to_root.map(|node| nodes[node].0).collect();
    path.reverse();
    Ok(path)
}

fn between(a: [f64; 2], b: [f64; 2], t: f64) -> [f64; 2] {
    [0, 1].map(|axis| (1.0 - t) * a[axis] + t * b[axis])
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// True if the motion from `a` to `b` touches no disc.
fn is_free_way(a: [f64; 2], b: [f64; 2]) -> bool {
    let is_outside = |state, (disc, radius)| distance(state, disc) > radius;
    let is_free = |state| DISCS.iter().all(|&disc| is_outside(state, disc));
    let steps = (distance(a, b) / RESOLUTION).ceil().max(1.0);
    (0..=steps as usize).all(|step| is_free(between(a, b, step as f64 / steps)))
}
