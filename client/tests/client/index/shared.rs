//! The shared form, against a real server in this process, over gRPC and over Zenoh.

mod processes;

use std::{
    collections::{BTreeMap, BTreeSet},
    thread,
    time::Duration,
};

use wayfold::{
    Client, ConnectionStatus, Error, Index, InsertOptions, OpenShared, PayloadEncoding,
    RetryPolicy, Search, Space,
};

use super::{conformance, feed::logged_by_drop};
use crate::server::Server;
use processes::{
    another_process_holds_the_same, no_edge_between_processes_is_missed, racing_writers_agree,
};

/// A server, and the session that reaches it over Zenoh; None over gRPC.
struct ServerLink {
    server: Server,
    #[cfg(feature = "zenoh")]
    session: Option<zenoh::Session>,
}

impl ServerLink {
    fn over_grpc() -> ServerLink {
        ServerLink {
            server: Server::start(),
            #[cfg(feature = "zenoh")]
            session: None,
        }
    }

    /// The server finds this session, and no other.
    #[cfg(feature = "zenoh")]
    fn over_zenoh() -> ServerLink {
        use zenoh::Wait;

        let alone = r#"listen: { endpoints: ["tcp/127.0.0.1:0"] },
            scouting: { multicast: { enabled: false }, gossip: { enabled: false } }"#;
        let config = zenoh::Config::from_json5(&format!("{{ {alone} }}")).unwrap();
        let session = zenoh::open(config).wait().unwrap();
        let locators = session.info().locators().wait();
        let server = Server::with(|config| {
            config.zenoh.listen = "tcp/127.0.0.1:0".into();
            config.zenoh.config = format!("{{ connect: {{ endpoints: ['{}'] }} }}", locators[0]);
        });
        let session = Some(session);
        ServerLink { server, session }
    }

    fn index(&self, name: &str) -> OpenShared {
        #[cfg(feature = "zenoh")]
        if let Some(session) = &self.session {
            return Index::shared_over_zenoh(session.clone(), "wayfold/v1", name);
        }
        Index::shared(&self.server.uri, name)
    }
}

fn shared(link: &ServerLink, name: &str, space: &Space) -> Index {
    link.index(name).create(space).open().unwrap()
}

macro_rules! tests {
    ($($test:ident),* $(,)?) => {
        mod over_grpc {
            $(#[test]
            fn $test() {
                super::$test(super::ServerLink::over_grpc());
            })*
        }

        #[cfg(feature = "zenoh")]
        mod over_zenoh {
            $(#[test]
            fn $test() {
                super::$test(super::ServerLink::over_zenoh());
            })*
        }
    };
}

tests!(
    equals_brute_force,
    refuses_what_is_no_state,
    any_timeout_is_taken,
    ends_a_search_that_takes_too_long,
    conforms_beside_writers_of_this_process,
    another_process_holds_the_same,
    racing_writers_agree,
    no_edge_between_processes_is_missed,
    declares_its_payloads,
    writes_to_an_index_that_is_gone_come_back,
    an_index_of_another_space_is_refused,
    it_may_be_used_and_dropped_in_a_task,
    a_closed_index_takes_no_writes_and_gives_none_back,
);

/// A server that reserves few ids at once gives them several times.
#[test]
fn blocks_of_ids_keep_to_the_limit_of_the_server() {
    let server = Server::with(|config| config.limits.max_reserved_ids = 10);
    let space = "R1".parse().unwrap();
    let index = Index::shared(&server.uri, "arm").create(&space).open();
    let index = index.unwrap();
    let mut ids: Vec<u64> = (0..50)
        .map(|number| index.insert([f64::from(number)]).unwrap())
        .collect();
    let rows: Vec<[f64; 1]> = (0..35).map(|number| [f64::from(number)]).collect();
    ids.extend(index.insert_many(&rows).unwrap());
    index.flush().unwrap();
    assert!(ids.is_sorted_by(|a, b| a < b), "{ids:?}");
    assert_eq!(index.len().unwrap(), ids.len());
}

/// The server takes the first rows and refuses the next ones. The index is dropped before anybody takes these back.
#[test]
fn a_refusal_amid_an_insert_of_many_rows_loses_no_id_and_is_logged() {
    let server = Server::with(|config| config.limits.max_points_per_index = 5_000);
    let index = Index::shared(&server.uri, "arm").create(&"R1".parse().unwrap());
    // Fewer bytes than the rows have: later parts of them wait.
    let index = index.max_pending_bytes(4_096 * 32).open().unwrap();
    let rows = (0..20_000).map(|number| [f64::from(number)]);
    let error = index.insert_many(rows).unwrap_err();
    let Error::Partial {
        done, ids, source, ..
    } = error
    else {
        panic!("{error}");
    };
    assert!(matches!(*source, Error::WritesRefused { .. }), "{source}");
    assert_eq!((source.reason(), ids.len()), (Some("QUOTA_EXCEEDED"), done));
    let stored = content(&Index::remote(&server.uri, "arm").open().unwrap());
    assert!(stored.keys().eq(&ids[..stored.len()]));
    assert!(!stored.is_empty() && stored.len() < done);
    assert_eq!(index.pending(), 0);
    let (line, unsent) = (logged_by_drop(index), done - stored.len());
    assert!(
        line.contains(&format!("pending=0 unsent={unsent}")),
        "{line}"
    );
}

/// The server answers an operation that it remembers with the session that it opened then, whose ids are not free.
#[test]
fn a_session_of_its_own_follows_each_refusal() {
    let server = Server::with(|config| config.limits.max_points_per_index = 1);
    let space = "R1".parse().unwrap();
    let copies = [(); 2].map(|()| Index::shared(&server.uri, "arm").create(&space).open());
    let copies = copies.map(Result::unwrap);
    for round in 0..4 {
        let index = &copies[round % 2];
        let id = index.insert([0.0]).unwrap();
        index.flush().unwrap();
        index.insert([1.0]).unwrap();
        let refused = index.flush().unwrap_err();
        assert_eq!(refused.reason(), Some("QUOTA_EXCEEDED"), "{round}");
        assert_eq!(index.take_unsent().len(), 1);
        assert!(index.remove(id).unwrap());
        index.flush().unwrap();
    }
}

/// The feed of the copy and five foreign ones hold what a server for one message of 20 kB allows. A shared index with 2
/// MB of pending writes and a client with one call wait until there is room. The environment variable `BUSY_SECONDS` sets
/// the time without room.
#[test]
fn a_busy_server_takes_the_writes_later() {
    let seconds = std::env::var("BUSY_SECONDS").map_or(1, |seconds| seconds.parse().unwrap());
    let busy = Duration::from_secs(seconds);
    let server = Server::with(|config| {
        config.grpc.max_message_bytes = 20_000;
        config.zenoh.max_message_bytes = 20_000;
        config.admission.max_bytes = 1;
    });
    let space = "R10".parse().unwrap();
    let index = Index::shared(&server.uri, "arm").create(&space).open();
    let index = index.unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let (mut handles, mut watches) = (Vec::new(), Vec::new());
    runtime.block_on(async {
        let patient = Client::builder().retry(RetryPolicy::until_deadline());
        let patient = patient.timeout(2 * busy + Duration::from_secs(30));
        // A connection has room for two.
        for count in [2, 2, 1] {
            let client = patient.clone().connect(&server.uri).await.unwrap();
            let handle = client.index("arm").await.unwrap();
            for _ in 0..count {
                watches.push(handle.watch().await.unwrap());
            }
            handles.push(handle);
        }
    });
    let ids: Vec<u64> = (0..25_000)
        .map(|number| index.insert([f64::from(number); 10]).unwrap())
        .collect();
    let inserting = runtime.spawn(handles[0].insert([[0.5; 10]]).into_future());
    let refused = loop {
        match index.status() {
            Some(ConnectionStatus::Disconnected { why, .. }) => break why,
            status => assert!(
                matches!(status, Some(ConnectionStatus::Following { .. })),
                "{status:?}"
            ),
        }
        thread::yield_now();
    };
    assert_eq!(refused.reason(), Some("TOO_MANY_BYTES"));
    let late = index.flush_within(busy).unwrap_err();
    assert!(matches!(late, Error::Timeout { .. }), "{late}");
    assert_eq!(index.pending(), ids.len() as u64);
    assert!(!inserting.is_finished());
    drop(watches);
    index.flush().unwrap();
    let inserted = runtime.block_on(inserting).unwrap().unwrap();
    let inserted: Vec<_> = inserted.outcomes.iter().map(|row| row.id()).collect();
    let other = Index::remote(&server.uri, "arm").open().unwrap();
    wait_for_same(&other, &index);
    let ids: BTreeSet<u64> = ids
        .into_iter()
        .chain(inserted.into_iter().flatten())
        .collect();
    assert_eq!(ids.len(), 25_001);
    assert_eq!(content(&index).into_keys().collect::<BTreeSet<_>>(), ids);
}

/// A name for each index of a server.
fn names() -> impl Fn() -> String {
    let next = std::cell::Cell::new(0);
    move || {
        next.set(next.get() + 1);
        format!("index-{}", next.get())
    }
}

/// The points of an index: their tags and states by id.
fn content(index: &Index) -> BTreeMap<u64, (u64, Vec<u64>)> {
    let bits = |state: Vec<f64>| state.into_iter().map(f64::to_bits).collect();
    let points = index.scan().unwrap().map(Result::unwrap);
    points
        .map(|point| (point.id, (point.tag, bits(point.state))))
        .collect()
}

/// Waits until `other` holds what `index` holds, after a flush.
fn wait_for_same(index: &Index, other: &Index) {
    index.flush().unwrap();
    let expected = content(index);
    let mut newest = other
        .changes(Default::default())
        .unwrap()
        .map(|changes| changes.read_revision);
    while content(other) != expected {
        let now = other.search(vec![0.0; other.space().coordinates()], &Search::k(1));
        newest = now.map(|found| found.read_revision).ok().max(newest);
        thread::yield_now();
    }
}

fn equals_brute_force(link: ServerLink) {
    let name = names();
    conformance::equals_brute_force(|space| shared(&link, &name(), space), 600);
}

fn any_timeout_is_taken(link: ServerLink) {
    let space = "R2".parse().unwrap();
    let index = link.index("index").create(&space).timeout(Duration::MAX);
    let index = index.open().unwrap();
    index.insert([1.0, 2.0]).unwrap();
    index.flush().unwrap();
}

fn refuses_what_is_no_state(link: ServerLink) {
    conformance::refuses_what_is_no_state(|space| shared(&link, "index", space));
}

fn ends_a_search_that_takes_too_long(link: ServerLink) {
    conformance::ends_a_search_that_takes_too_long(|space| shared(&link, "index", space));
}

fn conforms_beside_writers_of_this_process(link: ServerLink) {
    conformance::misses_no_edge(|space| shared(&link, "edges", space));
    conformance::answers_tell_what_they_have_read(|space| shared(&link, "answers", space));
}

fn declares_its_payloads(link: ServerLink) {
    let space: Space = "R1".parse().unwrap();
    conformance::declares_its_payloads(|name, encoding| {
        let index = link.index(name);
        match encoding {
            Some(encoding) => index.create(&space).payload_encoding(encoding).open(),
            None => index.open(),
        }
    });
}

/// An index that was made again refuses what is pending, which comes back in order. The copy tells the new index's encoding.
fn writes_to_an_index_that_is_gone_come_back(link: ServerLink) {
    let space: Space = "R1".parse().unwrap();
    let index = shared(&link, "index", &space);
    let first = index.insert([1.0]).unwrap();
    index.flush().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let client = link.server.client().await;
        client.delete_index("index").await.unwrap();
        let created = client.create_index_with("index", &space, PayloadEncoding::Edges);
        created.await.unwrap();
    });
    // Until the refusal arrives, writes are taken.
    let mut written = Vec::new();
    let refused = loop {
        match index.insert([2.0]) {
            Ok(id) => written.push(id),
            Err(error) => break error,
        }
    };
    assert!(matches!(refused, Error::WritesRefused { .. }), "{refused}");
    assert!(matches!(index.flush(), Err(Error::WritesRefused { .. })));
    let status = index.status().unwrap();
    assert!(
        matches!(status, ConnectionStatus::Refused { .. }),
        "{status:?}"
    );
    let unsent: Vec<u64> = index
        .take_unsent()
        .into_iter()
        .map(|write| match write {
            wayfold::UnsentWrite::Put { id, .. } => id,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(unsent, written);
    while index.get(first).unwrap().is_some() {
        thread::yield_now();
    }
    assert_eq!(index.len().unwrap(), 0);
    assert_eq!(index.payload_encoding(), PayloadEncoding::Edges);
    let id = index.insert([3.0]).unwrap();
    index.flush().unwrap();
    let fresh = shared(&link, "index", &space);
    assert_eq!(content(&fresh), content(&index));
    assert!(fresh.get(id).unwrap().is_some());
}

fn an_index_of_another_space_is_refused(link: ServerLink) {
    drop(shared(&link, "index", &Space::se2()));
    let other = link.index("index").create(&Space::se3()).open();
    assert_eq!(other.unwrap_err().code(), wayfold::Code::AlreadyExists);
    let missing = link.index("missing").open().unwrap_err();
    assert_eq!(missing.code(), wayfold::Code::NotFound);
}

/// Its calls block, and its drop does not, in a task of another runtime, also one of a single thread.
fn it_may_be_used_and_dropped_in_a_task(link: ServerLink) {
    let one_thread = tokio::runtime::Builder::new_current_thread().build();
    for runtime in [tokio::runtime::Runtime::new(), one_thread] {
        runtime.unwrap().block_on(async {
            let index = shared(&link, "index", &Space::se2());
            let options = InsertOptions::new().payload(b"start");
            let id = index.insert_with([0.0; 3], options).unwrap().id;
            assert_eq!(index.payload(id).unwrap(), Some(b"start".to_vec()));
            index.flush().unwrap();
            let other = shared(&link, "index", &Space::se2());
            assert_eq!(other.payload(id).unwrap(), Some(b"start".to_vec()));
            assert_eq!(other.payload(id + 1).unwrap(), None);
        });
    }
}

/// The index has the last handle of the session, whose end panics in a runtime of one thread.
#[cfg(feature = "zenoh")]
#[test]
fn its_session_ends_with_it_in_a_task() {
    let ServerLink { server, session } = ServerLink::over_zenoh();
    let index = Index::shared_over_zenoh(session.unwrap(), "wayfold/v1", "index");
    let index = index.create(&Space::se2()).open().unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().build();
    runtime.unwrap().block_on(async { drop(index) });
    drop(server);
}

fn a_closed_index_takes_no_writes_and_gives_none_back(link: ServerLink) {
    let index = shared(&link, "index", &Space::se2());
    index.insert([0.0; 3]).unwrap();
    assert_eq!(index.close(std::time::Duration::from_secs(20)), []);
    assert!(matches!(index.insert([1.0; 3]), Err(Error::Closed)));
    assert_eq!(index.len().unwrap(), 1);
    assert!(matches!(index.status(), Some(ConnectionStatus::Closed)));
    assert!(matches!(index.clear(), Err(Error::NotInMemory { .. })));
}
