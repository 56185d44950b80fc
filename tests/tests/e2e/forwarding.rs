//! The servers of a cluster forward mutations to the owner of the index, in the name of the caller, and do without it. The
//! environment variable `NATS_SERVER` has the path of the program nats-server.

use std::process::Command;

use tonic::{Code, Status};
use wayfold::{Client, Credentials, Space};
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{
    Process, ServerProcess, Signal, Stubs, insert_request,
    nats::{Nats, member_settings},
};

use crate::{
    access::authority::Authority,
    healing::{JOINS, together, wait_until_joined},
    journal_loss::Cluster,
    metrics::{calls, figures},
    shared::proxy::Proxy,
};

fn open_server() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_server-process"));
    command.args([
        "--grpc",
        "127.0.0.1:0",
        "--http",
        "127.0.0.1:0",
        "--data",
        "memory",
    ]);
    command
}

fn insert(at: f64) -> InsertRequest {
    insert_request("arm", &[at], 1)
}

/// Creates the index at the first server, and waits until all know it.
async fn create_everywhere(stubs: &mut [Stubs]) {
    stubs[0].create("arm", "R1").await;
    for other in &mut stubs[1..] {
        other.find("arm").await;
    }
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_command_watch_goes_on_at_another_server() {
    let cluster = Cluster::empty();
    let [server, other]: [_; 2] = together(&cluster, &[]);
    let mut stubs = Vec::new();
    for server in [&server, &other] {
        stubs.push(Stubs::connect(server.uri()).await);
    }
    create_everywhere(&mut stubs).await;
    let mut watch = Command::new(env!("CARGO_BIN_EXE_cli-process"));
    watch.args(["--server", &format!("{},{}", server.uri(), other.uri())]);
    let mut watch = Process::spawn(watch.args(["watch", "arm", "--after", "0"]));
    stubs[0].insert(insert(1.0)).await;
    let mut next = |revision: usize| {
        let line = watch.line().expect("a line");
        // Neither a gap nor a repetition.
        assert!(line.starts_with(&format!("revision {revision} ")), "{line}");
        line.contains("1 stored")
    };
    assert!(next(1));
    server.stop(Signal::Kill);
    stubs[1].insert(insert(2.0)).await;
    // The new owner of the index may have written a record of its own before.
    assert!(next(2) || next(3));
    watch.stop(Signal::Kill);
}

/// Both servers go on reading, and no mutation reaches them.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_command_watch_ends_while_no_server_reaches_nats() {
    let mut cluster = Cluster::empty();
    let [server, other]: [_; 2] = together(&cluster, &[]);
    let mut stubs = Vec::new();
    for server in [&server, &other] {
        stubs.push(Stubs::connect(server.uri()).await);
    }
    create_everywhere(&mut stubs).await;
    stubs[0].insert(insert(1.0)).await;
    let mut watch = Command::new(env!("CARGO_BIN_EXE_cli-process"));
    watch.args(["--server", &format!("{},{}", server.uri(), other.uri())]);
    let mut watch = Process::spawn(watch.args(["watch", "arm", "--after", "0"]));
    let line = watch.line().expect("a line");
    assert!(line.starts_with("revision 1 "), "{line}");
    cluster.nats.kill(0);
    let ended = tokio::task::spawn_blocking(move || watch.finish());
    assert_eq!(ended.await.unwrap().status.code(), Some(4));
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_owner_evaluates_the_mutations_of_all_servers_until_it_is_gone() {
    const EACH: u64 = 10;
    let cluster = Cluster::empty();
    let mut servers = Vec::from(together::<3>(&cluster, &[]));
    let pages: Vec<_> = servers.iter_mut().map(ServerProcess::pages).collect();
    let mut stubs = Vec::new();
    for server in &servers {
        stubs.push(Stubs::connect(server.uri()).await);
    }
    create_everywhere(&mut stubs).await;

    for at in 0..EACH {
        for stubs in &mut stubs {
            stubs.points.insert(insert(at as f64)).await.unwrap();
        }
    }
    let forwarded = calls("cluster", "insert", "arm", "OK");
    let taken = |page: &String| figures(page).get(&forwarded).copied().unwrap_or_default();
    let mut taken: Vec<f64> = pages.iter().map(taken).collect();
    let owner = taken.iter().position(|calls| *calls > 0.0).unwrap();
    assert_eq!(taken.remove(owner), 2.0 * EACH as f64);
    assert_eq!(taken, [0.0, 0.0]);

    // A refusal is the owner's, whole.
    let mut refusals = Vec::new();
    for stubs in &mut stubs {
        let refused: Status = stubs.points.insert(insert(f64::NAN)).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        refusals.push((refused.message().to_owned(), refused.details().to_vec()));
    }
    assert!(refusals.iter().all(|refusal| *refusal == refusals[0]));

    // A read sees what another server acknowledged.
    for stubs in &mut stubs {
        assert!(stubs.latest("arm").await.unwrap() >= 3 * EACH);
    }

    servers.remove(owner).stop(Signal::Kill);
    stubs.remove(owner);
    for stubs in &mut stubs {
        let claimed = InsertRequest {
            operation_id: "after the owner".into(),
            ..insert(-1.0)
        };
        let ids: Vec<_> = [claimed.clone(), claimed]
            .into_iter()
            .map(|claimed| async {
                stubs
                    .points
                    .clone()
                    .insert(claimed)
                    .await
                    .unwrap()
                    .into_inner()
            })
            .collect();
        let answers = futures_util::future::join_all(ids).await;
        assert_eq!(answers[0].ids, answers[1].ids);
    }
    stubs[0].latest("arm").await.unwrap();
    let count = stubs[0].describe("arm").await.point_count;
    assert_eq!(count, 3 * EACH + 1);
}

/// Each server shows the others its certificate, and the owner checks the rights of the caller once more.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_forwarded_call_has_the_identity_of_its_caller() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    let admin = authority.token("admin", "admin", "*");
    let writer = authority.token("writer", "write", "*");
    let nats = Nats::start(directory.path(), 1);
    let mut servers = [(); 3].map(|()| {
        let mut command = authority.command();
        command
            .env("WAYFOLD_LOG__FILTER", "info,wayfold_server::observe=debug")
            .env("WAYFOLD_CLUSTER__PEER_CA", authority.file("ca", "pem"))
            .envs(nats.member_settings());
        ServerProcess::ready(Process::spawn(&mut command))
    });
    wait_until_joined(&mut servers);
    let client = |server: &ServerProcess, token: &str| {
        let credentials: Credentials = authority.credentials().token(token.to_owned());
        let uri = server.uri().to_owned();
        async move {
            Client::builder()
                .credentials(credentials)
                .connect(&uri)
                .await
                .unwrap()
        }
    };
    let space: Space = "R1".parse().unwrap();
    for server in &servers {
        // The first creates it, and the others find it.
        let created = client(server, &admin).await;
        while created.create_index("arm", &space).await.is_err() {}
    }
    for server in &servers {
        let index = client(server, &writer).await.index("arm").await.unwrap();
        index.insert([[1.0]]).await.unwrap();
    }
    // Each server ends the call of its client, and the owner two that others forwarded.
    let mut ended = Vec::new();
    for server in servers {
        let log = server.stop(Signal::Terminate).stderr;
        let own = log
            .lines()
            .filter(|line| line.contains("call ended") && line.contains("PointService/Insert"));
        let own: Vec<String> = own.map(str::to_owned).collect();
        let named = own.iter().filter(|it| it.contains("identity=\"writer\""));
        assert_eq!(named.count(), own.len(), "{own:?}");
        ended.push(own.len());
    }
    ended.sort_unstable();
    assert_eq!(ended, [1, 1, 3]);
}

/// A stranger on the listener for members could act for every identity.
#[ignore = "needs nats-server"]
#[test]
fn a_server_with_identities_needs_certificates_of_its_members() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.token("admin", "admin", "*");
    let nats = Nats::start(directory.path(), 1);
    let mut command = authority.command();
    let refused = Process::spawn(command.envs(nats.member_settings())).finish();
    assert!(!refused.status.success());
    assert!(
        refused.stderr.contains("set cluster.peer_ca"),
        "{}",
        refused.stderr
    );

    let mut command = open_server();
    let member = command.envs(nats.member_settings());
    let beyond = member.env("WAYFOLD_CLUSTER__LISTEN", "0.0.0.0:0");
    let refused = Process::spawn(beyond).finish();
    assert!(
        refused.stderr.contains("set cluster.peer_ca"),
        "{}",
        refused.stderr
    );
}

#[ignore = "needs nats-server"]
#[test]
fn a_url_may_have_the_user_and_the_password_of_nats() {
    let directory = tempfile::tempdir().unwrap();
    let users = "authorization { user: wayfold, password: open-sesame }";
    let nats = Nats::start_with(directory.path(), 1, users);
    let mut command = open_server();
    let url = nats.urls().replace("//", "//wayfold:open-sesame@");
    command.envs(member_settings(&url, 1));
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
    assert!(
        !finished.stderr.contains("open-sesame"),
        "{}",
        finished.stderr
    );
}

/// Both servers hear NATS, and nothing comes back from one to the other.
#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_do_not_reach_each_other_go_on_alone() {
    let directory = tempfile::tempdir().unwrap();
    let nats = Nats::start(directory.path(), 1);
    let mut servers = Vec::new();
    for _ in 0..2 {
        // It leads nowhere until the server has an address.
        let way = Proxy::to("http://127.0.0.1:9").await;
        let mut command = open_server();
        let advertised = way.uri.trim_start_matches("http://").to_owned();
        command
            .envs(nats.member_settings())
            .env("WAYFOLD_CLUSTER__ADVERTISE", advertised);
        let mut server = ServerProcess::ready(Process::spawn(&mut command));
        let lines = server.log_until("joining the cluster");
        let line = lines.last().unwrap();
        let address = line.split("address=Some(").nth(1).unwrap();
        let address = format!("http://{}", address.split(')').next().unwrap());
        way.lead_to(&address);
        servers.push((server, way, address));
    }
    for (server, ..) in &mut servers {
        server.log_until(JOINS);
    }
    let mut stubs = Vec::new();
    for (server, ..) in &servers {
        stubs.push(Stubs::connect(server.uri()).await);
    }
    create_everywhere(&mut stubs).await;
    for at in 0..20 {
        if at == 10 {
            for (_, way, address) in &servers {
                way.hold(address);
            }
        }
        for (number, stubs) in stubs.iter_mut().enumerate() {
            let claimed = InsertRequest {
                operation_id: format!("{at} at {number}"),
                ..insert(at as f64)
            };
            stubs.points.insert(claimed).await.unwrap();
        }
    }
    for stubs in &mut stubs {
        stubs.latest("arm").await.unwrap();
        assert_eq!(stubs.describe("arm").await.point_count, 40);
    }
}
