//! A read that asks for the latest waits for what another server acknowledged. The environment variable `NATS_SERVER` has the
//! path of the program nats-server.

use std::process::Command;

use futures_util::{FutureExt, future::BoxFuture};
use tokio::task::spawn_blocking;
use wayfold::Index;
use wayfold_proto::v1::{self, knn_request::KForm, query_request::RadiusForm};
use wayfold_tests::{
    Process, ServerProcess, Stubs, insert_request,
    nats::{Nats, member_settings},
    row_states,
};

use crate::{healing::wait_until_joined, metrics::figures, shared::proxy::Proxy};

const MAX_INDICES: usize = 64;

fn start(nats: &str) -> ServerProcess {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command
        .args(["--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0"])
        .args(["--data", "memory"])
        .envs(member_settings(nats, 1));
    ServerProcess::ready(Process::spawn(&mut command))
}

async fn insert(stubs: &mut Stubs, index: &str, at: f64) -> Vec<u64> {
    stubs.insert(insert_request(index, &[at], 1)).await.ids
}

/// A read of the points at a state.
type Read = fn(Stubs, String, f64, bool) -> BoxFuture<'static, Vec<u64>>;

fn knn(
    mut stubs: Stubs,
    index_name: String,
    at: f64,
    latest: bool,
) -> BoxFuture<'static, Vec<u64>> {
    let request = v1::KnnRequest {
        index_name,
        states: Some(row_states(&[at], 1)),
        k_form: Some(KForm::K(1)),
        radius_form: Some(v1::knn_request::RadiusForm::Radius(0.0)),
        latest,
        ..Default::default()
    };
    async move {
        let answer = stubs.points.knn(request).await.unwrap().into_inner();
        answer.neighbors.unwrap().ids
    }
    .boxed()
}

fn query(
    mut stubs: Stubs,
    index_name: String,
    at: f64,
    latest: bool,
) -> BoxFuture<'static, Vec<u64>> {
    let request = v1::QueryRequest {
        index_name,
        states: Some(row_states(&[at], 1)),
        radius_form: Some(RadiusForm::Radius(0.0)),
        latest,
        ..Default::default()
    };
    async move {
        let answer = stubs.points.query(request).await.unwrap().into_inner();
        answer.neighbors.unwrap().ids
    }
    .boxed()
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_search_waits_for_what_another_server_acknowledged() {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    let journal = nats.urls().replace("nats://", "http://");
    let way = Proxy::to(&journal).await;
    let mut servers = [
        start(&nats.urls()),
        start(&way.uri.replace("http://", "nats://")),
    ];
    let pages = servers.each_mut().map(ServerProcess::pages);
    wait_until_joined(&mut servers);
    let mut owner = Stubs::connect(servers[0].uri()).await;
    let mut other = Stubs::connect(servers[1].uri()).await;

    // An index of the first server.
    let mut names = (0..MAX_INDICES).map(|number| format!("arm-{number}"));
    let index = loop {
        let name = names.next().expect("an index of the first server");
        owner.create(&name, "R1").await;
        other.find(&name).await;
        insert(&mut owner, &name, 0.0).await;
        let owned = format!("wayfold_index_owned{{index=\"{name}\"}}");
        if figures(&pages[0]).get(&owned) == Some(&1.0) {
            break name;
        }
    };
    let reads: [Read; 2] = [knn, query];
    for (at, read) in [1.0, 2.0].into_iter().zip(reads) {
        way.hold(&journal);
        let acknowledged = insert(&mut owner, &index, at).await;
        let ask = |latest| read(other.clone(), index.clone(), at, latest);
        let mut latest = ask(true);
        // Both go over one connection, in this order.
        tokio::select! {
            biased;
            early = &mut latest => panic!("{early:?}"),
            before = ask(false) => assert!(before.is_empty()),
        }
        way.lead_to(&journal);
        assert_eq!(latest.await, acknowledged);
    }

    // The same by the library.
    way.hold(&journal);
    let at = 3.0;
    let acknowledged = insert(&mut owner, &index, at).await;
    let ask = |latest: bool| {
        let open = Index::remote(servers[1].uri(), &index);
        let open = if latest { open.latest() } else { open };
        spawn_blocking(move || open.open().unwrap().nearest_r([at], 0.0).unwrap())
    };
    let mut latest = ask(true);
    tokio::select! {
        biased;
        early = &mut latest => panic!("{early:?}"),
        before = ask(false) => assert!(before.unwrap().is_empty()),
    }
    way.lead_to(&journal);
    let found = latest.await.unwrap();
    assert_eq!(
        found.iter().map(|it| it.id).collect::<Vec<_>>(),
        acknowledged
    );
}
