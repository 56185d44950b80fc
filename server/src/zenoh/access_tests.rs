//! Every key against every kind of caller. A key without a row fails the test.

use std::{
    fs,
    sync::Arc,
    time::{Duration, Instant},
};

use ::zenoh::bytes::ZBytes;
use sha2::{Digest, Sha256};

use super::queries::{attached, caller};
use crate::{
    identity::{Identities, Role},
    log::MemoryLog,
    service::Call,
    testing::server,
    verbs::{Form, Request, Verb, dispatch},
};

/// The role that a verb needs, and its request for the index `arm`, in JSON.
fn row(verb: Verb) -> (Role, &'static str) {
    match verb {
        Verb::Server | Verb::List => (Role::Read, ""),
        Verb::Create => (Role::Admin, r#"{"name": "arm", "space_text": "R1"}"#),
        Verb::Delete => (Role::Admin, r#"{"index_name": "arm"}"#),
        Verb::Knn | Verb::Query | Verb::Get | Verb::Scan | Verb::Info | Verb::Log => {
            (Role::Read, "")
        }
        Verb::Insert | Verb::Update | Verb::Remove | Verb::Session | Verb::Write => {
            (Role::Write, "{}")
        }
    }
}

/// The names of the identities, which are their tokens too.
const NAMES: [&str; 4] = ["read", "write", "admin", "leg"];

/// A file with the identities, one that has expired, and `others`.
fn identities(others: &[&str]) -> String {
    let mut text = String::new();
    for &name in NAMES.iter().chain(&["expired"]).chain(others) {
        let (role, pattern) = match name {
            "leg" => ("admin", "leg"),
            "expired" | "revoked" => ("admin", "arm"),
            role => (role, "arm"),
        };
        let digest = Sha256::digest(name);
        let digest = hex::encode(digest);
        text += &format!(
            "[[identity]]\nname = \"{name}\"\nrole = \"{role}\"\nindexes = [\"{pattern}\"]\ntoken_sha256 = \"{digest}\"\n"
        );
        if name == "expired" {
            text += "expires = \"2001-01-01T00:00:00Z\"\n";
        }
    }
    text
}

#[tokio::test(start_paused = true)]
async fn every_key_refuses_every_wrong_caller() {
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), identities(&["revoked"])).unwrap();
    let identities = Identities::open(Some(file.path())).unwrap();
    let revoked = identities.caller(Some(b"revoked"), None);
    assert_eq!(revoked.check(), Ok(()));
    fs::write(file.path(), self::identities(&[])).unwrap();
    let following = tokio::spawn(identities.clone().follow(Default::default()));
    while revoked.check().is_ok() {
        tokio::time::advance(Duration::from_secs(1)).await;
    }
    following.abort();
    let log = Arc::new(MemoryLog::new());
    let service = server(&log, &log);

    let caller = |attachment: Option<&str>| {
        let attachment = attachment.map(ZBytes::from);
        caller(&identities, &attached(attachment.as_ref()))
    };
    for (_, verb) in Verb::OF_INDEX.into_iter().chain(Verb::OF_SERVER) {
        let (needed, payload) = row(verb);
        let ask = async |caller| {
            let payload = payload.as_bytes().into();
            let request = Request::of(Form::Json, "arm", [], payload, Instant::now());
            let (request, _) = request.unwrap();
            let call = Call {
                caller,
                ..Call::default()
            };
            let answer = dispatch(&service, &call, verb, &request, 1 << 20).await;
            answer.map_err(|error| error.reason()).err()
        };
        for (attachment, expected) in [
            (None, "NO_CREDENTIAL"),
            (Some("traceparent=00"), "NO_CREDENTIAL"),
            (Some("admin"), "NO_CREDENTIAL"),
            (Some("token="), "WRONG_CREDENTIAL"),
            (Some("token=x"), "WRONG_CREDENTIAL"),
            (Some("token=expired"), "IDENTITY_EXPIRED"),
            (Some("token=revoked;traceparent=00"), "WRONG_CREDENTIAL"),
        ] {
            let refused = ask(caller(attachment)).await;
            assert_eq!(refused, Some(expected), "{} {attachment:?}", verb.name());
        }
        // A call that began before its identity was revoked.
        let refused = ask(revoked.clone()).await;
        assert_eq!(refused, Some("IDENTITY_REVOKED"), "{}", verb.name());
        for (name, role) in
            NAMES
                .into_iter()
                .zip([Role::Read, Role::Write, Role::Admin, Role::Admin])
        {
            let refused = ask(caller(Some(&format!("traceparent=00;token={name}")))).await;
            let is_of_no_index = matches!(verb, Verb::Server | Verb::List);
            match () {
                () if role < needed => assert_eq!(refused, Some("ROLE_TOO_LOW"), "{name}"),
                () if name == "leg" && !is_of_no_index => {
                    assert_eq!(refused, Some("INDEX_NOT_ALLOWED"), "{}", verb.name());
                }
                () => assert!(
                    !matches!(refused, Some("ROLE_TOO_LOW" | "INDEX_NOT_ALLOWED")),
                    "{} {name} {refused:?}",
                    verb.name()
                ),
            }
        }
    }
}
