//! A watch says which batch made a mutation, and leaves out the effects of the caller's own session.

use wayfold_server::service::Limits;

use super::*;

/// The messages up to a revision.
async fn watched(
    service: &Service,
    uid: &str,
    own_session: u64,
    last: u64,
) -> Vec<v1::WatchResponse> {
    let request = v1::WatchRequest {
        own_session,
        ..watching(uid, 0)
    };
    let mut watch = service.watch(&CALL, request).await.unwrap();
    let mut messages = Vec::new();
    let is_last = |it: &v1::Mutation| it.revision.as_ref().unwrap().number == last && !it.continued;
    while !messages
        .iter()
        .any(|it: &v1::WatchResponse| it.mutations.iter().any(is_last))
    {
        messages.push(watch.next().await.unwrap().unwrap());
    }
    messages
}

#[tokio::test]
async fn a_watch_leaves_out_the_points_of_its_own_session() {
    let limits = Limits {
        max_answer_bytes: 20_000,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R1", limits).await;
    let (one, _) = open(&service, &uid, 2_000).await;
    let (other, _) = open(&service, &uid, 2_000).await;
    for (number, rows) in [(1, 1), (2, 1_000), (3, 2)] {
        for session in [&one, &other] {
            let puts: Vec<Step> = (0..rows)
                .map(|at| Put(session.first + at, number as f64))
                .collect();
            write(&service, batch(session, number, &puts)).await;
        }
    }
    let plain = service.insert(&CALL, insertion(&[[7.0]], &[])).await;
    plain.unwrap();
    let removals: Vec<Step> = (0..1_000).map(|at| Remove(one.first + at)).collect();
    let last = write(&service, batch(&one, 4, &removals)).await;
    let last = last.revision.number();

    let all = watched(&service, &uid, 0, last).await;
    assert!(all.len() > 5, "the large batches come in pieces");
    let all: Vec<v1::Mutation> = all.into_iter().flat_map(|it| it.mutations).collect();
    let mut whole = all.iter().filter(|it| !it.continued);
    let made_by = whole.by_ref().map(|it| (it.session, it.batch));
    let batches = [1, 2, 3].map(|number| [(one.id, number), (other.id, number)]);
    let expected = [(0, 0), (0, 0)]
        .into_iter()
        .chain(batches.into_iter().flatten());
    assert!(made_by.eq(expected.chain([(0, 0), (one.id, 4)])));

    for session in [one.id, other.id] {
        let mut expected = all.clone();
        expected.retain(|it| it.session != session || it.piece == 0);
        for own in expected.iter_mut().filter(|it| it.session == session) {
            (own.stored, own.removed_ids, own.continued) = (None, Vec::new(), false);
        }
        let own = watched(&service, &uid, session, last).await;
        assert!(own.into_iter().flat_map(|it| it.mutations).eq(expected));
    }
}
