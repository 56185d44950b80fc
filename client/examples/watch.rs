//! Follows the mutations of an index: every one, in order.
//!
//!     cargo run --release                     # the server
//!     cargo run --release --example watch     # in another terminal; WAYFOLD_SERVER names a server elsewhere

use std::{env, error::Error};

use wayfold::{Client, IndexHandle, WatchEvent};

/// Marks a point as invalid. The planner defines the meaning of the tag's bits.
const INVALID: u64 = 1;

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let uri = env::var("WAYFOLD_SERVER");
    watch(uri.as_deref().unwrap_or("http://127.0.0.1:50051")).await?;
    Ok(())
}

/// Returns the ids of the valid points, as the watch reported them.
pub async fn watch(uri: &str) -> Result<Vec<u64>, Box<dyn Error>> {
    let client = Client::connect(uri).await?;
    let name = format!("watch-{}", std::process::id());
    let index = client.create_index(&name, &"R2".parse()?).await?;
    // Starts at the empty index; without `after`, the watch starts with the next mutation.
    let mut watch = index.watch().after(index.revision_at(0)).await?;
    // Another connection, as another process would have it.
    let other = Client::connect(uri).await?.index(&name).await?;
    let writer = tokio::spawn(async move { write(&other).await });

    let mut valid = Vec::new();
    // The fourth and last mutation is a removal.
    let mut is_last = false;
    while !is_last && let Some(event) = watch.next().await? {
        match event {
            WatchEvent::Mutation(mutation) => {
                println!("revision {}:", mutation.revision.number);
                for point in mutation.stored.iter() {
                    println!(
                        "  point {} at {:?}, tag {}",
                        point.id, point.state, point.tag
                    );
                    valid.retain(|id| *id != point.id);
                    if point.tag & INVALID == 0 {
                        valid.push(point.id);
                    }
                }
                for id in &mutation.removed_ids {
                    println!("  point {id} is removed");
                    valid.retain(|known| known != id);
                }
                is_last = !mutation.removed_ids.is_empty();
            }
            // The server cannot send the next mutations: read all points again, and watch from their revision.
            WatchEvent::Reset(reset) => println!("reset at revision {}", reset.revision.number),
        }
    }
    writer.await??;
    client.delete_index(&name).await?;
    Ok(valid)
}

/// Four mutations.
async fn write(index: &IndexHandle) -> Result<(), wayfold::Error> {
    index.insert([[0.0, 0.0], [1.0, 0.0]]).ids([1, 2]).await?;
    index.insert([[2.0, 0.0], [3.0, 0.0]]).ids([3, 4]).await?;
    // A collision was found.
    index.update([2]).tags([INVALID]).await?;
    index.remove([3]).await?;
    Ok(())
}
