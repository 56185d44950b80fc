//! Many searches under way on one stream.

use futures_util::StreamExt;
use wayfold::{Code, Error, Include};

use crate::{fake::Fake, server::Server, watching::scanned};

#[tokio::test]
async fn answers_come_in_the_order_of_the_requests() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index
        .insert((0..1000).map(|x| [f64::from(x)]))
        .await
        .unwrap();
    let (mut requests, mut answers) = index.stream_knn().await.unwrap();
    let sending = tokio::spawn({
        let index = index.clone();
        async move {
            for i in 0..2000_u32 {
                let x = f64::from(i * 7 % 1000);
                requests
                    .send(index.knn([[x], [x + 0.1]]).k(1 + i % 3))
                    .await
                    .unwrap();
            }
        }
    });
    for i in 0..2000_u32 {
        let answer = answers.next().await.unwrap().unwrap();
        assert_eq!(answer.len(), 2);
        assert_eq!(answer.row(0).nearest().unwrap().id, u64::from(i * 7 % 1000));
        assert_eq!(answer.row(1).len(), 1 + i as usize % 3);
    }
    assert_eq!(answers.next().await.unwrap(), None);
    sending.await.unwrap();
}

#[tokio::test]
async fn one_bad_request_does_not_end_the_stream() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let plane = server.index("plane", "R2").await;
    index.insert([[0.0], [1.0]]).await.unwrap();
    plane.insert([[0.0, 4.0]]).await.unwrap();
    let (mut requests, answers) = index.stream_knn().await.unwrap();
    let include = Include::none().states();
    requests.send(index.knn([[0.0]])).await.unwrap();
    requests.send(index.knn([[f64::NAN]])).await.unwrap();
    // A state of the wrong width is not sent.
    assert!(matches!(
        requests.send(index.knn([[0.0, 1.0]])).await,
        Err(Error::Width { .. })
    ));
    requests
        .send(plane.knn([[3.0, 0.0]]).include(include))
        .await
        .unwrap();
    drop(requests);
    let answers: Vec<_> = answers.into_stream().collect().await;
    assert_eq!(answers.len(), 3);
    assert_eq!(
        answers[0]
            .as_ref()
            .unwrap()
            .row(0)
            .ids()
            .collect::<Vec<_>>(),
        [0]
    );
    let Err(Error::Refused(refusal)) = &answers[1] else {
        panic!("{answers:?}")
    };
    assert_eq!(
        (refusal.code, &*refusal.reason),
        (Code::InvalidArgument, "NAN")
    );
    assert_eq!(refusal.fields[0].field, "states[0].coords[0]");
    let last = answers[2].as_ref().unwrap().row(0);
    assert_eq!(
        (last.distances().collect(), last.state(0)),
        (vec![5.0], Some(&[0.0, 4.0][..]))
    );
}

#[tokio::test]
async fn a_stream_that_is_over_takes_no_requests() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    // The fake ends each stream at once.
    let (mut requests, mut answers) = index.stream_knn().await.unwrap();
    assert_eq!(answers.next().await.unwrap(), None);
    drop(answers);
    let error = loop {
        if let Err(error) = requests.send(index.knn([[0.0]])).await {
            break error;
        }
    };
    assert_eq!(error.code(), Code::Unavailable);
}

#[tokio::test]
async fn scans_that_nobody_reads_on_do_not_stop_the_other_calls() {
    let fake = Fake::start().await;
    let points: Vec<_> = (0..100_000).map(|id| (id, 0.5)).collect();
    let part = scanned(3, &points).remove(0);
    let index = fake.client().await.index("line").await.unwrap();
    let mut scans = Vec::new();
    for _ in 0..8 {
        fake.scan_answers(vec![part.clone(); 4], true);
        let mut scan = index.scan().await.unwrap();
        assert_eq!(scan.next().await.unwrap().unwrap().len(), points.len());
        scans.push(scan);
    }
    index.knn([[0.0]]).await.unwrap();
    for scan in &mut scans {
        for _ in 1..4 {
            scan.next().await.unwrap().unwrap();
        }
        assert_eq!(scan.next().await.unwrap(), None);
    }
}
