//! The queries that a server of a cluster leaves to the others.

use tokio::sync::watch;
use zenoh::query::QueryTarget;

use super::*;

/// True if the server answers a query with this target.
async fn answers(robot: &Session, target: QueryTarget) -> bool {
    let query = robot.get("wayfold/v1/list").target(target);
    let replies = query.timeout(Duration::from_secs(60)).await.unwrap();
    replies.recv_async().await.is_ok()
}

/// Waits until the server answers queries with this target, or until it does not.
async fn wait_until(robot: &Session, target: QueryTarget, expected: bool) {
    let asking = async { while answers(robot, target).await != expected {} };
    let asked = timeout(Duration::from_secs(60), asking).await;
    asked.unwrap_or_else(|_| panic!("{target:?}: {expected} is expected"));
}

/// Robots whose queries always reach the same server would stay with one that is cut off. If no server is better, the query
/// still gets its answer.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_unfit_server_gets_only_queries_that_no_other_takes() {
    let (face, robot, _) =
        face_and_robot(Service::starting(Default::default()), Identities::default()).await;
    let (fit, fitness) = watch::channel(true);
    let following = tokio::spawn(face.offer.clone().follow(fitness));
    wait_until(&robot, QueryTarget::AllComplete, true).await;

    fit.send(false).unwrap();
    wait_until(&robot, QueryTarget::AllComplete, false).await;
    wait_until(&robot, QueryTarget::BestMatching, true).await;
    assert!(!answers(&robot, QueryTarget::AllComplete).await);

    fit.send(true).unwrap();
    wait_until(&robot, QueryTarget::AllComplete, true).await;
    drop(fit);
    following.await.unwrap();
    robot.close().await.unwrap();
    face.stop().await;
}
