//! An index that resumes after it had stopped.

use super::*;

/// The member may have records that NATS has lost, and this server has none of them.
#[tokio::test(start_paused = true)]
async fn an_index_that_resumes_after_a_loss_is_compared_again() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    let written = server.insert().await.unwrap();
    let registry = Arc::clone(server.service.registry().unwrap());
    let hosted = registry.get("arm").unwrap();
    server.is_set_back.notify_one();
    assert!(hosted.reached(written + 1).await.is_err());
    let recovering = tokio::task::spawn_blocking(move || registry.recover());
    recovering.await.unwrap().unwrap();
    assert!(!hosted.is_closed());

    // The members do not change.
    let own = server.own.read(entry.uid, None, usize::MAX).unwrap();
    let ahead = log_with(&entry, &more(&own, 1, 1));
    *server.others.members.lock() = vec![Some(ahead)];
    let refused = server.insert().await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert_eq!(server.own.newest(entry.uid), Ok(written));
}

/// NATS may have lost records after the member had answered.
#[tokio::test]
async fn a_comparison_that_ends_after_a_resumption_does_not_count() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    server.set(vec![Some(log_with(&entry, &records))]);
    server.others.are_answering.send_replace(false);
    let registry = Arc::clone(server.service.registry().unwrap());
    let hosted = registry.get("arm").unwrap();
    let resumed = async {
        while server.others.requests.load(SeqCst) == 0 {
            tokio::task::yield_now().await;
        }
        server.is_set_back.notify_one();
        assert!(hosted.reached(RECORDS + 1).await.is_err());
        let recovering = tokio::task::spawn_blocking(move || registry.recover());
        recovering.await.unwrap().unwrap();
        server.others.are_answering.send_replace(true);
    };
    let call = Call::default();
    let (compared, ()) = tokio::join!(server.service.may_write(&call, &hosted), resumed);
    compared.unwrap();
    assert!(!hosted.is_closed() && !server.service.is_compared(&hosted));
}
