//! A client of several servers: where it connects, when it goes to another one, and what it never goes back behind.

use std::{thread, time::Duration};

use tokio::runtime::Runtime;
use tonic::Status as Answer;
use wayfold::{Client, Code, Error, Filter, Index, IndexHandle, RetryPolicy, WatchEvent};
use wayfold_proto::v1;

use crate::{
    fake::Fake,
    retrying::quick,
    server::Server,
    watching::{message, piece, scanned, wait_for, wait_until_caught_up},
};

/// An address that refuses connections.
const DEAD: &str = "127.0.0.1:0";

fn several<const N: usize>(addresses: [&str; N]) -> String {
    addresses.join(",")
}

/// A client of these servers that tries a call four times, with short pauses.
async fn connect<const N: usize>(addresses: [&str; N]) -> Client {
    let client = Client::builder().retry(quick(4));
    client.connect(&several(addresses)).await.unwrap()
}

/// Fakes, a client of them, and its handle of their index.
pub(crate) async fn start<const N: usize>() -> ([Fake; N], Client, IndexHandle) {
    let mut fakes = Vec::with_capacity(N);
    for _ in 0..N {
        fakes.push(Fake::start().await);
    }
    let Ok(fakes) = <[Fake; N]>::try_from(fakes) else {
        panic!("not as many as were started");
    };
    let client = connect(fakes.each_ref().map(|fake| fake.uri.as_str())).await;
    let index = client.index("line").await.unwrap();
    (fakes, client, index)
}

/// The revisions that reads asked for.
pub(crate) fn asked_for(requests: impl IntoIterator<Item = Option<v1::Revision>>) -> Vec<u64> {
    let revisions = requests.into_iter().map(Option::unwrap_or_default);
    revisions.map(|revision| revision.number).collect()
}

#[tokio::test]
async fn the_first_server_that_answers_is_used() {
    let (first, second) = (Fake::start().await, Fake::start().await);
    let client = connect([DEAD, &first.uri, &second.uri]).await;
    assert_eq!(
        client.uri(),
        several(["http://127.0.0.1:0", &first.uri, &second.uri])
    );
    client.index("line").await.unwrap();
    client.index("line").await.unwrap();
    assert_eq!((first.calls(), second.calls()), (2, 0));
}

#[tokio::test]
async fn where_no_server_is_every_address_is_named_with_the_reason() {
    let client = Client::builder().retry(RetryPolicy::never());
    let addresses = several([DEAD, "http://localhost:0"]);
    let error = client.connect(&addresses).await.unwrap_err();
    assert_eq!(error.code(), Code::Unavailable);
    let message = error.to_string();
    let parts: Vec<&str> = message.split("; ").collect();
    let [first, second] = parts[..] else {
        panic!("{message}");
    };
    let refused = "connect: no connection to http://127.0.0.1:0,http://localhost:0: \
                   http://127.0.0.1:0: Connection refused";
    assert!(first.starts_with(refused), "{message}");
    assert!(second.starts_with("http://localhost:0: "), "{message}");
}

#[tokio::test]
async fn the_address_that_is_none_is_named() {
    let fake = Fake::start().await;
    for wrong in [
        "",
        "http://",
        "ftp://127.0.0.1:0",
        "http://a b",
        "http://127.0.0.1:99999",
        "[::1]:x",
    ] {
        for addresses in [wrong, &several([&fake.uri, wrong])] {
            let error = Client::connect(addresses).await.unwrap_err();
            assert!(
                matches!(&error, Error::Address { uri, .. } if uri == wrong),
                "{error}"
            );
        }
    }
}

/// The server's runtime ends with all its connections.
#[test]
fn a_call_after_a_server_has_died_goes_to_the_next_one() {
    let (dying, living) = (Runtime::new().unwrap(), Runtime::new().unwrap());
    let first = dying.block_on(Fake::start());
    living.block_on(async {
        let second = Fake::start().await;
        let client = connect([&first.uri, &second.uri]).await;
        let index = client.index("line").await.unwrap();
        assert_eq!((first.calls(), second.calls()), (1, 0));
        dying.shutdown_background();
        while tokio::net::TcpStream::connect(first.uri.trim_start_matches("http://"))
            .await
            .is_ok()
        {
            tokio::task::yield_now().await;
        }
        index.knn([[0.0]]).await.unwrap();
        index.knn([[0.0]]).await.unwrap();
        assert_eq!((first.calls(), second.calls()), (1, 2));
    });
}

#[tokio::test]
async fn a_call_that_is_unavailable_is_retried_at_the_next_server() {
    let ([first, second], _, index) = start::<2>().await;
    first.unavailable(usize::MAX);
    index.knn([[0.0]]).await.unwrap();
    index.knn([[0.0]]).await.unwrap();
    assert_eq!((first.calls(), second.calls()), (1, 2));

    // Each retry goes to the next one, also back to the first.
    second.unavailable(usize::MAX);
    first.unavailable(1);
    index.knn([[0.0]]).await.unwrap();
    assert_eq!((first.calls(), second.calls()), (2, 2));
}

#[tokio::test]
async fn other_refusals_are_not_retried() {
    let ([first, second], _, index) = start::<2>().await;
    for code in [
        Code::InvalidArgument,
        Code::NotFound,
        Code::ResourceExhausted,
        Code::Internal,
        Code::Unknown,
        Code::DeadlineExceeded,
    ] {
        first.fail(move |_, _| Some(Answer::new(code, "no")));
        assert_eq!(index.knn([[0.0]]).await.unwrap_err().code(), code);
        assert_eq!((first.calls(), second.calls()), (1, 0), "{code:?}");
    }
}

/// Each retry is the same mutation, wherever it goes.
#[tokio::test]
async fn a_mutation_keeps_its_operation_id_at_the_next_server() {
    let ([first, second], _, index) = start::<2>().await;
    // Another call comes before the first mutation at a server.
    first.fail(|_, rows| (rows > 0).then(|| Answer::unavailable("no answer from NATS")));
    index.insert([[0.0]]).await.unwrap();
    let sent = |fake: &Fake| fake.insert_requests()[0].operation_id.clone();
    assert_eq!(sent(&first), sent(&second));
    assert!(!sent(&first).is_empty());
}

#[tokio::test]
async fn the_next_server_is_asked_for_the_newest_revision_that_was_seen() {
    let ([first, second], client, index) = start::<2>().await;
    first.tell([9]);
    index.insert([[0.0]]).await.unwrap();
    first.unavailable(usize::MAX);

    // The first read waits for the newest revision. Descriptions are of older ones until the client has waited too.
    second.tell([9, 9, 3, 9, 9, 3, 9, 9]);
    index.knn([[0.0]]).await.unwrap();
    let described = client.index_info("line").await.unwrap();
    assert_eq!(described.revision.number, 9);
    // Another handle has seen what the client has seen.
    let other = client.index("line").await.unwrap();
    assert_eq!(other.revision().number, 9);
    let reads = second.knn_requests().into_iter();
    assert_eq!(asked_for(reads.map(|read| read.min_revision)), [9]);
    let waits = second.get_requests().into_iter();
    assert_eq!(asked_for(waits.map(|wait| wait.min_revision)), [9, 9, 9]);
}

/// Other calls see newer revisions all the time.
#[tokio::test]
async fn a_description_waits_for_no_revision_that_was_seen_after_its_first_answer() {
    let ([first, second], _, index) = start::<2>().await;
    first.tell([9]);
    index.insert([[0.0]]).await.unwrap();
    first.unavailable(usize::MAX);
    second.tell([3, 9]);
    let other = index.clone();
    second.fail(move |number, _| {
        if number > 0 {
            let newer = other.revision_at(9 + number as u64);
            other.see_revision(&newer).unwrap();
        }
        None
    });
    assert_eq!(index.info().await.unwrap().revision.number, 9);
    // The client describes the index, waits, and describes it again.
    assert_eq!((second.calls(), second.gets().len()), (3, 1));
}

/// The points that a mutation names may be missing in an older revision.
#[tokio::test]
async fn the_next_server_has_the_newest_revision_before_it_mutates() {
    let ([first, second], _, index) = start::<2>().await;
    first.tell([7]);
    index.insert([[0.0]]).await.unwrap();
    first.unavailable(usize::MAX);
    for id in [1, 2] {
        index.remove([id]).await.unwrap();
    }
    let waits = second.get_requests().into_iter();
    assert_eq!(asked_for(waits.map(|wait| wait.min_revision)), [7]);
    assert_eq!(second.remove_requests().len(), 2);
}

#[tokio::test]
async fn nothing_is_asked_of_a_single_server_that_was_not_asked_before() {
    let ([fake], client, index) = start::<1>().await;
    fake.tell([9]);
    index.insert([[0.0]]).await.unwrap();
    fake.tell([3]);
    assert_eq!(
        client.index("line").await.unwrap().revision().number,
        3,
        "a handle begins at the revision of its own answer"
    );
    assert_eq!(fake.get_requests(), []);
}

#[tokio::test]
async fn a_watch_goes_where_the_client_goes() {
    let ([first, second], _, index) = start::<2>().await;
    first.watch_tells(vec![Ok(message(7, vec![]))]);
    // It lags: the first message names a revision before the one that the caller has.
    second.watch_tells(vec![
        Ok(message(4, vec![])),
        Ok(message(8, vec![piece(8, &[(1, 0.5)], &[], (0, false))])),
    ]);
    let mut watch = index.watch().await.unwrap();
    first.unavailable(usize::MAX);
    index.knn([[0.0]]).await.unwrap();
    let event = watch.next().await.unwrap().unwrap();
    assert!(
        matches!(&event, WatchEvent::Mutation(mutation) if mutation.revision.number == 8),
        "{event:?}"
    );
    let requests = second.watch_requests().into_iter();
    assert_eq!(asked_for(requests.map(|it| it.after_revision)), [7]);
}

/// The second server takes the watch and breaks its connection; the third serves it.
#[tokio::test]
async fn a_watch_passes_over_servers_that_cannot_serve_it() {
    let ([first, second, third], _, index) = start::<3>().await;
    let breaks = || Err(Answer::unavailable("the server is stopping"));
    first.watch_tells(vec![Ok(message(7, vec![])), breaks()]);
    second.watch_tells(vec![breaks()]);
    third.watch_tells(vec![
        Ok(message(7, vec![])),
        Ok(message(8, vec![piece(8, &[(1, 0.5)], &[], (0, false))])),
    ]);
    let mut watch = index.watch().await.unwrap();
    let event = watch.next().await.unwrap().unwrap();
    assert!(
        matches!(&event, WatchEvent::Mutation(mutation) if mutation.revision.number == 8),
        "{event:?}"
    );
}

#[tokio::test]
async fn a_watch_leaves_a_silent_server_while_there_is_time_for_the_next() {
    let ([first, second], _, index) = start::<2>().await;
    first.fall_silent();
    second.watch_tells(vec![Ok(message(7, vec![]))]);
    let index = index.with_timeout(Duration::from_secs(4));
    assert_eq!(index.watch().await.unwrap().newest().number, 7);
}

/// The fake's scans and watches are the script: a scan more would find nothing.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_copy_of_a_shared_index_goes_on_at_a_server_that_lags() {
    let (first, second) = (Fake::start().await, Fake::start().await);
    first.scan_answers(scanned(3, &[(1, 0.0)]), true);
    first.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(4, &[(2, 1.0)], &[], (0, false))])),
        Err(Answer::unavailable("the server is stopping")),
    ]);
    // It has two records fewer than the copy when the feed begins.
    second.watch_tells(vec![
        Ok(message(2, vec![])),
        Ok(message(5, vec![piece(5, &[(3, 2.0)], &[], (0, false))])),
    ]);
    let servers = several([&first.uri, &second.uri]);
    let index = Index::shared(&servers, "line").open().unwrap();
    wait_for(&index, &[(1, 0.0), (2, 1.0), (3, 2.0)]);
    let after = |fake: &Fake| {
        let requests = fake.watch_requests().into_iter();
        asked_for(requests.map(|request| request.after_revision))
    };
    assert_eq!((after(&first), after(&second)), (vec![3], vec![4]));
    wait_until_caught_up(&index);
}

/// A server that was cut off may not know an index yet.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_copy_looks_for_its_index_at_the_next_server() {
    let (first, second) = (Fake::start().await, Fake::start().await);
    first.scan_answers(scanned(3, &[(1, 0.0)]), true);
    first.watch_tells(vec![Err(Answer::not_found("no index is named so"))]);
    second.watch_tells(vec![
        Ok(message(4, vec![])),
        Ok(message(4, vec![piece(4, &[(2, 1.0)], &[], (0, false))])),
    ]);
    let servers = several([&first.uri, &second.uri]);
    let index = Index::shared(&servers, "line").open().unwrap();
    wait_for(&index, &[(1, 0.0), (2, 1.0)]);
}

/// Only a refusal that another server may not repeat is not final. The fake takes no writes.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn writes_to_a_server_that_lacks_the_index_go_to_the_next_one() {
    let (first, second) = (Fake::start().await, Fake::start().await);
    first.scan_answers(scanned(3, &[(1, 0.0)]), true);
    first.watch_tells(vec![Ok(message(3, vec![]))]);
    let servers = several([&first.uri, &second.uri]);
    let index = Index::shared(&servers, "line").open().unwrap();
    while first.watch_requests().is_empty() {
        thread::yield_now();
    }
    first.fail(|_, _| Some(Answer::not_found("no index is named so")));
    index.insert([5.0]).unwrap();
    let refused = index.flush().unwrap_err();
    assert!(matches!(refused, Error::WritesRefused { .. }), "{refused}");
    assert_eq!(refused.code(), Code::Unimplemented);
}

/// The server lets a scan wait for a few seconds only.
#[tokio::test]
async fn a_scan_waits_for_the_revision_of_its_filter_before_it_begins() {
    let ([fake], _, index) = start::<1>().await;
    fake.scan_answers(scanned(9, &[(1, 0.0)]), true);
    let later = Filter::default().since(index.revision_at(9));
    index.scan().filter(later).await.unwrap();
    let waits = fake.get_requests().into_iter();
    assert_eq!(asked_for(waits.map(|wait| wait.min_revision)), [9]);
}

/// It has not reached it in the time in which another server is worth a try.
#[tokio::test]
async fn a_scan_leaves_a_server_that_lacks_the_newest_revision() {
    let ([first, second], _, index) = start::<2>().await;
    first.tell([9]);
    index.knn([[0.0]]).await.unwrap();
    first.fail(|_, _| Some(Answer::deadline_exceeded("waiting for revision 9")));
    second.scan_answers(scanned(9, &[(1, 0.0)]), true);
    index.scan().await.unwrap();
    assert_eq!((first.calls(), second.gets().len()), (1, 1));
}

/// The second of two servers has nothing of the first, and so no index.
#[tokio::test]
async fn a_server_that_stops_is_left() {
    let (first, second) = (Server::start(), Server::start());
    first.index("line", "R1").await;
    let client = connect([&first.uri, &second.uri]).await;
    assert_eq!(client.list_indexes().await.unwrap().indexes.len(), 1);
    drop(first);
    while !client.list_indexes().await.unwrap().indexes.is_empty() {
        tokio::task::yield_now().await;
    }
    assert!(client.is_serving().await.unwrap());
}
