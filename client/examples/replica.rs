//! A replica: a copy of an index in this process, which follows the server's and is searched without the network.
//!
//!     cargo run --release                       # the server
//!     cargo run --release --example replica     # in another terminal; WAYFOLD_SERVER names a server elsewhere

use std::{
    env,
    error::Error,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::Client;

/// The number of points, and the number of searches.
const POINTS: usize = 20_000;
const SEARCHES: usize = 1000;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    let [server, replica] = replica(uri.as_deref().unwrap_or("http://127.0.0.1:50051")).await?;
    let each = |time: Duration| time.as_secs_f64() * 1e6 / SEARCHES as f64;
    println!("a search takes {:.0} µs by the server", each(server));
    println!("a search takes {:.1} µs by the replica", each(replica));
    Ok(())
}

/// Returns the time of the searches by the server, and by the replica.
pub async fn replica(uri: &str) -> Result<[Duration; 2], Box<dyn Error>> {
    let client = Client::connect(uri).await?;
    let name = format!("replica-{}", std::process::id());
    let index = client.create_index(&name, &"R3".parse()?).await?;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut states = |count| -> Vec<[f64; 3]> { (0..count).map(|_| random.random()).collect() };
    index.insert(states(POINTS)).await?;

    // Reads all points, and from then on follows the mutations, also across restarts of the server.
    let replica = client.replica(&name).await?;
    let queries = states(SEARCHES);
    let (mut by_server, mut by_replica) = (Vec::new(), Vec::new());
    let start = Instant::now();
    for query in &queries {
        by_server.push(index.knn([query]).k(10).await?);
    }
    let server_time = start.elapsed();
    let start = Instant::now();
    for query in &queries {
        by_replica.push(replica.knn(query, 10)?);
    }
    let replica_time = start.elapsed();

    // Both are exact: at the same revision the answers are the same, to the last bit.
    for (by_server, by_replica) in by_server.iter().zip(&by_replica) {
        assert!(by_server.row(0).iter().eq(by_replica.iter()));
    }

    // Another planner's insert arrives by itself. A planner that needs it waits for its revision.
    let inserted = index.insert([[0.5, 0.5, 0.5]]).await?;
    let view = replica.at_least(&inserted.revision).await?;
    println!("the replica has revision {}", view.revision().number);
    client.delete_index(&name).await?;
    Ok([server_time, replica_time])
}
