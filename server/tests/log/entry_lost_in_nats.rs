//! The entry of an index that NATS has lost while servers know it.

use std::{slice::from_ref, sync::Arc, time::Duration};

use futures_util::StreamExt;
use tokio::time::timeout;
use wayfold_server::log::LogError;

use crate::{
    entry,
    nats::{Nats, NatsServer},
};

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
    let (nats, entry) = (Nats::start(), entry("arm"));
    let (name, uid) = (entry.name.as_str(), entry.uid);
    let [log, other] = [(), ()].map(|()| nats.connect(Arc::default()));
    log.catalogue.create(entry.clone()).unwrap();
    nats.until(&other, |it| it.indexes().unwrap() == [entry.clone()]);

    nats.runtime.block_on(lose(&nats.server));
    log.catalogue.note_contradiction(uid, 3).unwrap();
    nats.until(&other, |it| it.contradiction(name, uid) == Some(3));
    // One that starts now knows of both.
    let third = nats.connect(Arc::default()).catalogue;
    assert_eq!(third.indexes().unwrap(), from_ref(&entry));
    assert_eq!(third.contradiction(name, uid), Some(3));

    nats.runtime.block_on(lose(&nats.server));
    other.catalogue.delete(uid).unwrap();
    nats.until(&log, |it| it.indexes().unwrap().is_empty());
}

#[ignore = "needs nats-server"]
#[test]
fn an_entry_that_nats_has_lost_is_written_again() {
    let (nats, entry) = (Nats::start(), entry("arm"));
    let mut log = nats.connect(Arc::default());
    log.catalogue.create(entry.clone()).unwrap();
    log.catalogue.note_contradiction(entry.uid, 3).unwrap();
    // The first server started with an empty bucket, the second one with the entry.
    for start in ["empty", "filled"] {
        let mut changes = log.catalogue.changes().unwrap();
        changes.mark_unchanged();
        nats.runtime.block_on(lose(&nats.server));
        let change = async { timeout(Duration::from_secs(60), changes.changed()).await };
        nats.runtime.block_on(change).expect(start).unwrap();
        // The new connection takes the place of the old one, which ends.
        log = nats.connect(Arc::default());
        assert_eq!(log.catalogue.indexes().unwrap(), from_ref(&entry));
        assert_eq!(log.catalogue.contradiction("arm", entry.uid), Some(3));
    }
}

/// The name was given to another index after the loss: the server that knows the lost one does not take it back.
#[ignore = "needs nats-server"]
#[test]
fn a_name_that_another_index_got_after_the_loss_is_taken() {
    let (nats, [lost, new]) = (Nats::start(), [(), ()].map(|()| entry("arm")));
    let log = nats.connect(Arc::default());
    log.catalogue.create(lost.clone()).unwrap();
    nats.runtime.block_on(lose(&nats.server));
    let other = nats.connect(Arc::default());
    other.catalogue.create(new.clone()).unwrap();
    nats.until(&log, |it| it.indexes().unwrap() == [new.clone()]);
    let refused = log.catalogue.claim(&lost, None).unwrap_err();
    assert!(matches!(refused, LogError::NameTaken { .. }), "{refused}");
}
