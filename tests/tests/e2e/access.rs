//! A server with TLS and identities: certificates that are renewed under load, and callers with and without rights.

pub(crate) mod authority;
mod command_line;
mod handshakes;
mod over_zenoh;
mod pages;
mod passwords;

use std::{
    fs,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::Duration,
};

use tokio::net::TcpStream;
use tokio_rustls::{
    TlsConnector,
    rustls::{ClientConfig, RootCertStore, pki_types::CertificateDer},
};
use wayfold::{Client, Code, Credentials, RetryPolicy, Space};
use wayfold_tests::{Process, ServerProcess, Signal, page};

use authority::Authority;

/// The server takes this address for one beyond this machine, and only this machine reaches it.
const BEYOND: &str = "[::ffff:127.0.0.1]:0";

const CALLERS: u64 = 4;
/// The calls of one connection of a caller.
const CALLS: usize = 10;

/// Asserts that a log with all lines has a token in no form.
fn assert_secret(token: &str, log: &str) {
    assert!(log.contains(" TRACE "), "{log}");
    let decimal: Vec<String> = token.bytes().map(|byte| byte.to_string()).collect();
    let hex: Vec<String> = token.bytes().map(|byte| format!("{byte:02x}")).collect();
    for form in [
        token.to_owned(),
        hex.concat(),
        hex.join(", "),
        decimal.join(", "),
    ] {
        assert!(!log.contains(&form), "a token is in the log");
    }
}

/// The certificate that a server presents to a new connection.
async fn presented(authority: &Authority, server: &ServerProcess) -> CertificateDer<'static> {
    let mut roots = RootCertStore::empty();
    roots.add(authority.issuer.der().clone()).unwrap();
    let mut config = ClientConfig::builder()
        .with_root_certificates(roots)
        .with_no_client_auth();
    config.alpn_protocols = vec![b"h2".to_vec()];
    let address = server.uri().trim_start_matches("https://");
    let socket = TcpStream::connect(address).await.unwrap();
    let connector = TlsConnector::from(Arc::new(config));
    let name = "127.0.0.1".try_into().unwrap();
    let stream = connector.connect(name, socket).await.unwrap();
    let chain = stream.get_ref().1.peer_certificates().unwrap();
    chain[0].clone().into_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn certificates_are_renewed_without_a_failed_call() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    let first = authority.certify("server");
    let token = authority.token("admin", "admin", "*");
    let server = ServerProcess::ready(Process::spawn(&mut authority.command()));
    let uri = server.uri().to_owned();
    let credentials = authority.credentials().token(token);
    let client = Client::builder().retry(RetryPolicy::never());
    let client = client.credentials(credentials.clone()).connect(&uri);
    let space: Space = "R1".parse().unwrap();
    let index = client.await.unwrap().create_index("arm", &space).await;
    let index = index.unwrap();
    assert_eq!(presented(&authority, &server).await, first);

    let done = Arc::new(AtomicBool::new(false));
    let callers = (0..CALLERS).map(|caller| {
        let (uri, credentials, done) = (uri.clone(), credentials.clone(), Arc::clone(&done));
        tokio::spawn(async move {
            let mut inserted = 0;
            while !done.load(Relaxed) {
                // A retry would hide a failed call.
                let client = Client::builder().retry(RetryPolicy::never());
                let client = client.credentials(credentials.clone()).connect(&uri);
                let index = client.await.unwrap().index("arm").await;
                let index = index.unwrap();
                for _ in 0..CALLS {
                    index.insert([[caller as f64]]).await.unwrap();
                    inserted += 1;
                }
            }
            inserted
        })
    });
    let callers: Vec<_> = callers.collect();
    let second = authority.certify("server");
    while presented(&authority, &server).await != second {}
    // Files that do not fit leave it in use.
    fs::write(authority.file("server", "pem"), "no certificate").unwrap();
    let third = authority.certify("server");
    while presented(&authority, &server).await != third {}
    done.store(true, Relaxed);
    let mut inserted = 0;
    for caller in callers {
        inserted += caller.await.unwrap();
    }
    // The first connection is the same since before.
    assert_eq!(index.info().await.unwrap().point_count, inserted);
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

/// The certificate of the second server does not have the name by which the first is addressed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_of_several_servers_is_known_by_its_own_name() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    let token = authority.token("reader", "read", "*");
    let [first, second] = ["localhost", "planning.example"].map(|name| {
        authority.certify(name);
        let mut command = authority.command();
        command
            .env("WAYFOLD_TLS__CERTIFICATE", authority.file(name, "pem"))
            .env("WAYFOLD_TLS__KEY", authority.file(name, "key"));
        ServerProcess::ready(Process::spawn(&mut command))
    });
    let uris = [&first, &second].map(|server| server.uri().to_owned());
    let uris = [uris[0].replace("127.0.0.1", "localhost"), uris[1].clone()].join(",");
    let credentials = authority.credentials().token(token);
    let client = Client::builder().credentials(credentials);
    let client = client.connect(&uris).await.unwrap();
    client.server().await.unwrap();
    first.stop(Signal::Kill);
    client.server().await.unwrap();
    second.stop(Signal::Kill);
    assert_eq!(client.server().await.unwrap_err().code(), Code::Unavailable);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_or_a_token_is_an_identity_and_nothing_else_is() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.certify("planner.example");
    authority.certify("nobody.example");
    let admin = authority.token("admin", "admin", "*");
    let identities = authority.file("identities", "toml");
    let entry = "[[identity]]\nname = \"planner\"\nrole = \"read\"\nindexes = [\"arm\"]\n\
                 certificate = \"planner.example\"\n";
    let before = fs::read_to_string(&identities).unwrap();
    fs::write(&identities, before.clone() + entry).unwrap();
    // The most that the server and its libraries write.
    let mut command = authority.command();
    command.env("WAYFOLD_LOG__FILTER", "trace,zenoh=trace");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let uri = server.uri().to_owned();
    let connect = async |credentials: Credentials| {
        let builder = Client::builder().credentials(credentials);
        builder.connect(&uri).await
    };
    let client = connect(authority.credentials().token(&*admin)).await;
    let space: Space = "R1".parse().unwrap();
    let client = client.unwrap();
    let index = client.create_index("arm", &space).await.unwrap();
    index.insert([[1.0]]).await.unwrap();

    let with = |name: &str| authority.with(&authority, name);
    let planner = connect(with("planner.example")).await.unwrap();
    let seen = planner.index("arm").await.unwrap();
    assert_eq!(seen.knn([[0.0]]).k(1).await.unwrap().row(0).len(), 1);
    let refused = seen.insert([[2.0]]).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
    assert_eq!(refused.reason(), Some("ROLE_TOO_LOW"));
    client.create_index("leg", &space).await.unwrap();
    let refused = planner.index("leg").await.unwrap_err();
    assert_eq!(refused.reason(), Some("INDEX_NOT_ALLOWED"));
    // The connection of a certificate whose identity is removed stays open.
    fs::write(&identities, before).unwrap();
    let refused = async {
        loop {
            if let Err(refused) = seen.info().await {
                break refused;
            }
        }
    };
    let refused = tokio::time::timeout(Duration::from_secs(60), refused).await;
    // The server tells a call under way that it revoked the identity.
    assert_eq!(refused.unwrap().code(), Code::Unauthenticated);
    let refused = seen.info().await.unwrap_err();
    assert_eq!(refused.reason(), Some("WRONG_CREDENTIAL"));
    for (credentials, reason) in [
        (with("nobody.example"), "WRONG_CREDENTIAL"),
        (authority.credentials(), "NO_CREDENTIAL"),
        (
            authority.credentials().token("wayfold_of_a_stranger"),
            "WRONG_CREDENTIAL",
        ),
    ] {
        let client = connect(credentials).await.unwrap();
        let refused = client.index("arm").await.unwrap_err();
        assert_eq!(refused.code(), Code::Unauthenticated, "{refused}");
        assert_eq!(refused.reason(), Some(reason));
        // Probes have no identity.
        assert!(client.is_serving().await.unwrap());
    }
    // Another authority's certificate ends the handshake, and so does plain text.
    let other = tempfile::tempdir().unwrap();
    let other = Authority::new(other.path());
    other.certify("planner.example");
    let forged = authority.with(&other, "planner.example");
    let quick = Client::builder().retry(RetryPolicy::never());
    let strangers = [
        (uri.clone(), forged),
        (uri.clone(), other.credentials()),
        (uri.replace("https", "http"), Credentials::new()),
    ];
    for (uri, credentials) in strangers {
        let connected = quick.clone().credentials(credentials).connect(&uri).await;
        let failed = match connected {
            Ok(client) => client.index("arm").await.map(drop).unwrap_err(),
            Err(error) => error,
        };
        assert_eq!(failed.code(), Code::Unavailable, "{failed}");
    }
    let log = server.stop(Signal::Terminate).stderr;
    for token in [&*admin, "wayfold_of_a_stranger"] {
        assert_secret(token, &log);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_identity_has_its_quotas() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    let admin = authority.token("admin", "admin", "*");
    let cell = authority.token("cell", "admin", "cell-*");
    let identities = authority.file("identities", "toml");
    let entries = fs::read_to_string(&identities).unwrap();
    fs::write(&identities, entries + "max_calls = 2\nmax_indexes = 2\n").unwrap();
    let mut command = authority.command();
    command.args(["--http", "127.0.0.1:0", "--zenoh", "off"]);
    let mut server = ServerProcess::ready(Process::spawn(&mut command));
    let pages = server.pages();
    let connect = async |token: &str| {
        let builder = Client::builder().retry(RetryPolicy::never());
        let credentials = authority.credentials().token(token);
        let client = builder.credentials(credentials).connect(server.uri());
        client.await.unwrap()
    };
    let bearer = format!("Authorization: Bearer {admin}\r\n");
    let (admin, cell) = (connect(&admin).await, connect(&cell).await);
    let space: Space = "R1".parse().unwrap();
    // The quota counts the indices that match the patterns of the cell, also those of the admin.
    for name in ["cell-1", "arm", "leg"] {
        admin.create_index(name, &space).await.unwrap();
    }
    let index = cell.create_index("cell-2", &space).await.unwrap();
    let refused = cell.create_index("cell-3", &space).await.unwrap_err();
    assert_eq!(refused.reason(), Some("LIMIT_EXCEEDED"), "{refused}");
    assert!(
        refused
            .to_string()
            .contains("max_indexes of the identity = 2")
    );
    admin.delete_index("cell-1").await.unwrap();
    cell.create_index("cell-3", &space).await.unwrap();

    let mut first = index.watch().await.unwrap();
    let second = index.watch().await.unwrap();
    let refused = index.info().await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert_eq!(refused.reason(), Some("TOO_MANY_CALLS"));
    let (_, metrics) = page(&pages, "/metrics", &bearer);
    let counted = "wayfold_refused_calls_total{reason=\"TOO_MANY_CALLS\"} 1\n";
    assert!(metrics.contains(counted), "{metrics}");
    admin
        .index("cell-2")
        .await
        .unwrap()
        .insert([[1.0]])
        .await
        .unwrap();
    first.next().await.unwrap();
    drop(second);
    // The server learns of the end of a stream after the client.
    while index.info().await.is_err() {}
}

#[test]
fn beyond_this_machine_nothing_is_served_without_both() {
    let open = |arguments: &[&str]| {
        let program = env!("CARGO_BIN_EXE_server-process");
        let all = [&["--data", "memory"], arguments].concat();
        let refused = Process::start(program, &all).finish();
        assert_eq!(refused.status.code(), Some(1), "{}", refused.stderr);
        refused.stderr
    };
    let log = open(&["--grpc", "0.0.0.0:0", "--zenoh", "off"]);
    assert!(log.contains("without TLS and identities"), "{log}");
    assert!(log.contains("--insecure"), "{log}");
    let log = open(&["--grpc", "127.0.0.1:0", "--zenoh", "tls/0.0.0.0:0"]);
    assert!(log.contains("without identities"), "{log}");
}

#[test]
fn an_insecure_server_starts_and_says_so_each_time() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let arguments = ["--data", data, "--grpc", BEYOND, "--zenoh", "off"];
    let program = env!("CARGO_BIN_EXE_server-process");
    let refused = Process::start(program, &arguments).finish();
    assert_eq!(refused.status.code(), Some(1), "{}", refused.stderr);
    let why = "grpc.listen: [::ffff:127.0.0.1]";
    assert!(refused.stderr.contains(why), "{}", refused.stderr);
    for filter in ["info", "off"] {
        let all = [&arguments[..], &["--insecure", "--log", filter]].concat();
        let server = ServerProcess::ready(Process::start(program, &all));
        let ended = server.stop(Signal::Terminate);
        let said = ended.stdout.join("\n");
        let warning =
            "insecure, without TLS and identities: everyone who reaches grpc.listen: [::ffff";
        assert!(said.contains(warning), "{said}");
        if filter == "info" {
            let log = ended.stderr;
            assert!(log.contains("insecure: everyone who reaches"), "{log}");
            assert!(log.contains("[::ffff:127.0.0.1]"), "{log}");
        }
    }
}
