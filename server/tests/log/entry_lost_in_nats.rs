//! The entry of an index that NATS has lost while servers know it.

use std::{slice::from_ref, sync::Arc};

use futures_util::StreamExt;
use tokio::runtime::{Builder, Runtime};
use wayfold_server::log::{Log, LogError, MemoryLog, connect_nats};

use crate::{
    entry,
    nats::{NatsServer, until},
};

fn connect(runtime: &Runtime, server: &NatsServer) -> Log {
    let _entered = runtime.enter();
    let connected = connect_nats(&server.options(), Arc::new(MemoryLog::new()));
    connected.unwrap().0
}

/// Loses the values of the catalogue, which has one.
async fn lose(server: &NatsServer) {
    let client = async_nats::connect(server.options().servers).await.unwrap();
    let context = async_nats::jetstream::new(client);
    let mut streams = context.streams();
    while let Some(stream) = streams.next().await {
        let config = stream.unwrap().config;
        if config.name.starts_with("KV_") {
            let stream = context.get_stream(&config.name).await.unwrap();
            assert_eq!(stream.purge().await.unwrap().purged, 1);
            return;
        }
    }
    panic!("no catalogue");
}

#[ignore = "needs nats-server"]
#[test]
fn an_entry_that_nats_has_lost_can_still_be_changed() {
    let (server, entry) = (NatsServer::start(), entry("arm"));
    let (name, uid) = (entry.name.as_str(), entry.uid);
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let [log, other] = [(), ()].map(|()| connect(&runtime, &server));
    log.catalogue.create(entry.clone()).unwrap();
    let of_other = &*other.catalogue;
    until(&runtime, of_other, || {
        of_other.indexes().unwrap() == [entry.clone()]
    });

    runtime.block_on(lose(&server));
    log.catalogue.note_contradiction(uid, 3).unwrap();
    until(&runtime, of_other, || {
        of_other.contradiction(name, uid) == Some(3)
    });
    // One that starts now knows of both.
    let third = connect(&runtime, &server).catalogue;
    assert_eq!(third.indexes().unwrap(), from_ref(&entry));
    assert_eq!(third.contradiction(name, uid), Some(3));

    runtime.block_on(lose(&server));
    of_other.delete(uid).unwrap();
    until(&runtime, &*log.catalogue, || {
        log.catalogue.indexes().unwrap().is_empty()
    });
}

#[ignore = "needs nats-server"]
#[test]
fn an_entry_that_nats_has_lost_is_written_again() {
    let (server, entry) = (NatsServer::start(), entry("arm"));
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let log = connect(&runtime, &server);
    log.catalogue.create(entry.clone()).unwrap();
    log.catalogue.note_contradiction(entry.uid, 3).unwrap();
    let mut changes = log.catalogue.changes().unwrap();
    changes.mark_unchanged();
    runtime.block_on(lose(&server));
    runtime.block_on(changes.changed()).unwrap();
    let started = connect(&runtime, &server).catalogue;
    assert_eq!(started.indexes().unwrap(), from_ref(&entry));
    assert_eq!(started.contradiction("arm", entry.uid), Some(3));
}

/// The name was given to another index after the loss: the server that knows the lost one does not take it back.
#[ignore = "needs nats-server"]
#[test]
fn a_name_that_another_index_got_after_the_loss_is_taken() {
    let (server, [lost, new]) = (NatsServer::start(), [(), ()].map(|()| entry("arm")));
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let log = connect(&runtime, &server);
    log.catalogue.create(lost.clone()).unwrap();
    runtime.block_on(lose(&server));
    let other = connect(&runtime, &server);
    other.catalogue.create(new.clone()).unwrap();
    until(&runtime, &*log.catalogue, || {
        log.catalogue.indexes().unwrap() == [new.clone()]
    });
    let refused = log.catalogue.claim(&lost, None).unwrap_err();
    assert!(matches!(refused, LogError::NameTaken { .. }), "{refused}");
}
