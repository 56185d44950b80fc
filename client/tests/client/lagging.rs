//! A client of three servers that leaves the first. The second never reaches the newest revision that the client has
//! seen, and the third has it.

use std::time::Duration;

use tonic::Status;
use wayfold::{Client, IndexHandle};

use crate::{
    failover::{asked_for, start},
    fake::Fake,
    retrying::last_timeouts,
};

/// The newest revision that the client has seen.
const NEWEST: u64 = 100;

/// The longest wait at a server that lags.
const MAX_WAIT: Duration = Duration::from_secs(5);

struct Servers {
    client: Client,
    index: IndexHandle,
    first: Fake,
    second: Fake,
    third: Fake,
}

impl Servers {
    /// The second server answers its first `described` calls, and lets the others wait in vain.
    async fn start(described: usize) -> Servers {
        let ([first, second, third], client, index) = start::<3>().await;
        first.tell([NEWEST]);
        index.insert([[0.0]]).await.unwrap();
        first.unavailable(usize::MAX);
        second.tell([NEWEST - 10]);
        // A server answers so once the time that the request names is over.
        second.fail(move |number, _| {
            (number >= described).then(|| Status::deadline_exceeded("waiting for revision 100"))
        });
        third.tell([NEWEST]);
        Servers {
            client,
            index,
            first,
            second,
            third,
        }
    }

    /// The revisions for which the third server was asked to wait.
    fn waits(&self) -> Vec<u64> {
        let waits = self.third.get_requests().into_iter();
        asked_for(waits.map(|wait| wait.min_revision))
    }

    /// The time of the last call at the second server.
    fn last_wait(&self) -> Duration {
        last_timeouts(&self.second).next().unwrap()
    }
}

#[tokio::test]
async fn a_read_goes_on_at_the_next_server() {
    let servers = Servers::start(0).await;
    servers.index.knn([[0.0]]).await.unwrap();
    assert_eq!(servers.second.calls(), 1);
    assert!(servers.last_wait() <= MAX_WAIT);

    // Only the wait is short. The timeout of the read is 30 s.
    let read = last_timeouts(&servers.third).next().unwrap();
    assert!(read > Duration::from_secs(20), "{read:?}");
    let reads = servers.third.knn_requests().into_iter();
    assert_eq!(asked_for(reads.map(|read| read.min_revision)), [NEWEST]);

    // The server has the revision now.
    servers.index.knn([[0.0]]).await.unwrap();
    assert_eq!(servers.waits(), [NEWEST]);
    assert_eq!((servers.second.calls(), servers.third.calls()), (1, 3));
}

/// The server had the newest revision of the client at its first call.
#[tokio::test]
async fn a_read_leaves_a_server_that_begins_to_lag() {
    let (fakes, _, index) = start::<3>().await;
    for fake in &fakes {
        fake.tell([NEWEST]);
    }
    index.insert([[0.0]]).await.unwrap();
    fakes[0].fall_silent();
    let index = index.with_timeout(Duration::from_secs(4));
    index.knn([[0.0]]).await.unwrap();
    let reads = fakes.each_ref().map(|fake| fake.knn_requests().len());
    assert_eq!(reads, [1, 1, 0]);
}

#[tokio::test]
async fn a_mutation_goes_on_at_the_next_server() {
    let servers = Servers::start(0).await;
    servers.index.remove([1]).await.unwrap();
    assert!(servers.last_wait() <= MAX_WAIT);
    assert_eq!(servers.waits(), [NEWEST]);
    assert_eq!(servers.second.remove_requests(), []);
    assert_eq!(servers.third.remove_requests().len(), 1);
}

#[tokio::test]
async fn a_description_goes_on_at_the_next_server() {
    let servers = Servers::start(1).await;
    let described = servers.client.index_info("line").await.unwrap();
    assert_eq!(described.revision.number, NEWEST);
    assert!(servers.last_wait() <= MAX_WAIT);
    assert_eq!(servers.waits(), [NEWEST]);
    assert_eq!((servers.second.calls(), servers.third.calls()), (2, 2));
}

/// Three waits of two seconds are as long as the call.
#[tokio::test]
async fn a_short_timeout_leaves_time_for_the_other_servers() {
    let servers = Servers::start(0).await;
    let index = servers.index.with_timeout(Duration::from_secs(6));
    index.knn([[0.0]]).await.unwrap();
    assert!(servers.last_wait() <= Duration::from_secs(2));
}

/// The last attempt is made at the first server, which has come back.
#[tokio::test]
async fn the_last_attempt_waits_for_the_time_of_the_call() {
    let servers = Servers::start(0).await;
    servers.first.unavailable(1);
    servers.third.unavailable(usize::MAX);
    servers.index.knn([[0.0]]).await.unwrap();
    assert_eq!((servers.second.calls(), servers.third.calls()), (1, 1));
    let asked: Vec<_> = last_timeouts(&servers.first).take(2).collect();
    let is_long = |time: &Duration| *time > Duration::from_secs(20);
    assert!(asked.iter().all(is_long), "{asked:?}");
}
