//! The name of an index that NATS gives after the server that claimed it has given up.

use std::{slice::from_ref, sync::Arc};

use tokio::runtime::Builder;
use wayfold_server::log::{LogError, MemoryLog, NatsOptions, connect_nats};

use crate::{
    entry,
    nats::{NatsServer, until},
};

/// A user that gets answers, but no message of a subscription: its server learns of other servers' changes late.
const BLIND: &str = "no_auth_user: any
authorization { users: [
    { user: any, password: any },
    { user: blind, password: any, permissions: { subscribe: { deny: \"_INBOX.*\" } } },
] }";

#[ignore = "needs nats-server"]
#[test]
fn a_repeated_claim_leaves_an_index_whose_claim_was_taken_late() {
    let (server, [first, second]) = (
        NatsServer::start_with(BLIND),
        [(), ()].map(|()| entry("arm")),
    );
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let options = server.options();
    let blind = NatsOptions {
        servers: options.servers.replace("nats://", "nats://blind:any@"),
        ..options.clone()
    };
    let [log, other] = [blind, options].map(|options| {
        let _entered = runtime.enter();
        let connected = connect_nats(&options, Arc::new(MemoryLog::new()));
        connected.unwrap().0
    });
    let of_other = &*other.catalogue;

    server.signal("STOP");
    let unanswered = log.catalogue.create(first.clone()).unwrap_err();
    assert!(
        matches!(unanswered, LogError::Unreachable { .. }),
        "{unanswered}"
    );
    server.signal("CONT");
    until(&runtime, of_other, || {
        of_other.indexes().unwrap() == from_ref(&first)
    });

    let taken = LogError::NameTaken { name: "arm".into() };
    assert_eq!(log.catalogue.create(second), Err(taken));
    for log in [&log, &other] {
        assert_eq!(log.catalogue.indexes().unwrap(), from_ref(&first));
    }
}
