//! An index of poses, and the nearest of them.
//!
//!     cargo run --release                     # the server
//!     cargo run --release --example hello     # in another terminal; WAYFOLD_SERVER names a server elsewhere

use std::{env, error::Error};

use wayfold::{Client, Include};

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    hello(uri.as_deref().unwrap_or("http://127.0.0.1:50051")).await?;
    Ok(())
}

/// Returns the ids of the two docks nearest to a robot.
pub async fn hello(uri: &str) -> Result<Vec<u64>, Box<dyn Error>> {
    let client = Client::connect(uri).await?;

    // A pose in the plane: a position in metres, and a heading in radians, which wraps around. The weight makes a
    // radian count as half a metre: d² = dx² + dy² + 0.25·dθ².
    let space = "R2*SO2:0.25".parse()?;
    // An index that exists with the same space is opened.
    let docks = client.create_index("docks", &space).await?;

    // One call is one mutation: all of it takes effect, or nothing. The server assigns the ids unless they are given.
    // With given ids the call can be repeated: the second run of this program finds the points unchanged.
    let poses = [[1.0, 0.0, 0.0], [4.0, 3.0, 1.57], [0.0, 2.0, 3.1]];
    let inserted = docks.insert(poses).ids([1, 2, 3]).await?;
    println!("{:?}", inserted.outcomes);

    // The robot heads almost exactly west, as dock 3 does, but from the other side of ±π.
    let robot = [0.0, 1.5, -3.1];
    let include = Include::none().states();
    let found = docks.knn([robot]).k(2).include(include).await?;
    let near = found.row(0);
    println!("at revision {}, near {robot:?}:", found.revision().number);
    for (i, dock) in near.iter().enumerate() {
        let pose = near.state(i).unwrap_or_default();
        println!(
            "dock {} at {pose:?}, distance {:.3}",
            dock.id, dock.distance
        );
    }
    Ok(near.ids().collect())
}
