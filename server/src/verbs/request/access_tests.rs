//! Every key against every kind of caller. A key without a row fails the test.

use std::{fs, sync::Arc};

use sha2::{Digest, Sha256};

use super::*;
use crate::{
    identity::{Identities, Role},
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Limits, Service},
    verbs::{
        dispatch,
        verb::{IndexVerb, PointVerb},
    },
};

/// The role that a verb needs, and its request for the index `arm`, in JSON.
fn row(verb: Verb) -> (Role, &'static str) {
    use {IndexVerb as Index, PointVerb as Point};
    match verb {
        Verb::OfServer(Index::Server | Index::List) => (Role::Read, ""),
        Verb::OfServer(Index::Create) => (Role::Admin, r#"{"name": "arm", "space_text": "R1"}"#),
        Verb::OfServer(Index::Delete) => (Role::Admin, r#"{"index_name": "arm"}"#),
        Verb::OfIndex(
            Point::Knn | Point::Query | Point::Get | Point::Scan | Point::Info | Point::Log,
        ) => (Role::Read, ""),
        Verb::OfIndex(
            Point::Insert | Point::Update | Point::Remove | Point::Session | Point::Write,
        ) => (Role::Write, "{}"),
    }
}

#[tokio::test]
async fn every_key_refuses_every_wrong_caller() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut text = String::new();
    let names = ["read", "write", "admin", "leg"];
    for name in names {
        let (role, pattern) = match name {
            "leg" => ("admin", "leg"),
            role => (role, "arm"),
        };
        let digest = Sha256::digest(name);
        let digest: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        text += &format!(
            "[[identity]]\nname = \"{name}\"\nrole = \"{role}\"\nindexes = [\"{pattern}\"]\ntoken_sha256 = \"{digest}\"\n"
        );
    }
    fs::write(file.path(), text).unwrap();
    let identities = Identities::open(Some(file.path())).unwrap();
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();

    let of_index = PointVerb::ALL.map(|(_, verb)| Verb::OfIndex(verb));
    let of_server = IndexVerb::ALL.map(|(_, verb)| Verb::OfServer(verb));
    for verb in of_index.into_iter().chain(of_server) {
        let (needed, payload) = row(verb);
        let ask = async |caller| {
            let request = Request {
                form: Form::Json,
                index: "arm",
                parameters: Vec::new(),
                payload: payload.as_bytes().into(),
            };
            let call = Call {
                caller,
                ..Call::default()
            };
            let answer = dispatch(&service, &call, verb, &request, 1 << 20).await;
            answer.map_err(|error| error.reason()).err()
        };
        for (token, expected) in [(None, "NO_CREDENTIAL"), (Some("x"), "WRONG_CREDENTIAL")] {
            let stranger = identities.caller(token.map(str::as_bytes), None);
            assert_eq!(ask(stranger).await, Some(expected), "{}", verb.name());
        }
        for (name, role) in
            names
                .into_iter()
                .zip([Role::Read, Role::Write, Role::Admin, Role::Admin])
        {
            let caller = identities.caller(Some(name.as_bytes()), None);
            let refused = ask(caller).await;
            let is_of_server = matches!(verb, Verb::OfServer(IndexVerb::Server | IndexVerb::List));
            match () {
                () if role < needed => assert_eq!(refused, Some("ROLE_TOO_LOW"), "{name}"),
                () if name == "leg" && !is_of_server => {
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
