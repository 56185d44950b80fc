//! The same over Zenoh: its links have TLS of their own, and a token is an attachment.

use wayfold::{Credentials, Error, Index, Space};
use wayfold_tests::{Process, ServerProcess, Signal, measuring, server};

use super::{
    assert_secret,
    authority::{Authority, wayfold},
};

/// The links of Zenoh are encrypted, and the command line finds the server only with the certificate of its authority.
#[test]
fn there_is_tls_too() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new(directory.path());
    authority.certify("server");
    authority.token("robot", "admin", "*");
    let links = serde_json::json!({ "transport": { "link": { "tls": {
        "listen_certificate": authority.file("server", "pem"),
        "listen_private_key": authority.file("server", "key"),
    } } } });
    let mut command = authority.command();
    command
        .args(["--zenoh", "tls/127.0.0.1:0"])
        .env("WAYFOLD_ZENOH__CONFIG", links.to_string())
        .env("WAYFOLD_ACCESS__PUBLISH_EVENTS", "on");
    let mut server = ServerProcess::ready(Process::spawn(&mut command));
    let locator = server.zenoh();
    assert!(locator.starts_with("tls/127.0.0.1:"), "{locator}");
    let ca = authority.file("ca", "pem");
    let token = authority.file("robot", "token");
    let (ca, token) = (ca.to_str().unwrap(), token.to_str().unwrap());
    let known = ["--ca", ca, "--token-file", token];
    let create = ["--server", server.uri(), "create", "arm", "--space", "R2"];
    let created = wayfold(&[&create[..], &known].concat());
    assert!(created.status.success(), "{}", created.stderr);
    let load = [
        "load",
        "arm",
        "--face",
        "zenoh",
        "--locator",
        &locator,
        "--calls",
        "100",
        "--json",
    ];
    let loaded = wayfold(&[&load[..], &known].concat());
    assert!(loaded.status.success(), "{}", loaded.stderr);
    let result: serde_json::Value = serde_json::from_str(&loaded.stdout.join("\n")).unwrap();
    assert_eq!(result["total"]["answered"], 100, "{result}");
    let other = tempfile::tempdir().unwrap();
    Authority::new(other.path());
    let wrong = other.path().join("ca.pem");
    let wrong = ["--ca", wrong.to_str().unwrap(), "--token-file", token];
    let refused = wayfold(&[&load[..], &wrong].concat());
    assert!(!refused.status.success());
    assert!(
        refused.stderr.contains("tls/127.0.0.1"),
        "{}",
        refused.stderr
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_is_the_attachment_and_events_stay_unpublished_unless_allowed() {
    for publishes in ["off", "on"] {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::new(directory.path());
        let token = authority.token("robot", "admin", "*");
        let identities = authority.file("identities", "toml");
        let mut server = server!("--zenoh", "tcp/127.0.0.1:0";
            ("WAYFOLD_ACCESS__IDENTITIES", identities.to_str().unwrap()),
            ("WAYFOLD_ACCESS__PUBLISH_EVENTS", publishes),
            ("WAYFOLD_LOG__FILTER", "trace,zenoh=trace"));
        let session = measuring::connect(&server.zenoh()).await;
        let events = session.declare_subscriber("wayfold/v1/*/events").await;
        let events = events.unwrap();
        let space: Space = "R1".parse().unwrap();
        let open = |credentials: Credentials| {
            let (session, space) = (session.clone(), space.clone());
            let open = move || {
                let index = Index::shared_over_zenoh(session, "wayfold/v1", "arm");
                index.create(&space).credentials(credentials).open()
            };
            tokio::task::spawn_blocking(open)
        };
        let stranger = open(Credentials::new()).await.unwrap().unwrap_err();
        assert_eq!(stranger.reason(), Some("NO_CREDENTIAL"), "{stranger}");
        let index = open(Credentials::new().token(&*token)).await.unwrap();
        let index = index.unwrap();
        let written = tokio::task::spawn_blocking(move || {
            // A server that publishes has sent the first mutations before it acknowledges the last.
            (0..20).try_for_each(|number| {
                index.insert([f64::from(number)])?;
                index.flush()
            })
        });
        written
            .await
            .unwrap()
            .unwrap_or_else(|error: Error| panic!("{error}"));
        match publishes {
            "on" => drop(events.recv_async().await.unwrap()),
            _ => assert!(events.try_recv().unwrap().is_none()),
        }
        let log = server.stop(Signal::Terminate).stderr;
        assert_secret(&token, &log);
    }
}
