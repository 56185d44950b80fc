//! Snapshots, restores and verifications through the library, and how they fail.

use std::time::Duration;

use futures_util::{StreamExt, stream};
use wayfold::{Code, Error, SnapshotError, SnapshotPart, SnapshotReader, SnapshotWriter, States};
use wayfold_proto::{
    snapshot::{Header, Writer},
    v1::{self, verify_index_response::Result as Answer},
};

use crate::{fake::Fake, server::Server};

/// A snapshot of an index in R1 with these parts of points.
fn parts(parts: &[&[f64]]) -> Vec<v1::SnapshotPart> {
    let points: usize = parts.iter().map(|part| part.len()).sum();
    let mut writer = Writer::new();
    let mut made = vec![writer.header(&Header {
        name: "line".into(),
        uid: "past".into(),
        space: "R1".parse().unwrap(),
        revision: 4,
        next_id: points as u64,
        point_count: points as u64,
        payload_encoding: Default::default(),
    })];
    let mut id = 0..;
    for part in parts {
        let ids: Vec<u64> = id.by_ref().take(part.len()).collect();
        let points = v1::Points {
            tags: vec![0; ids.len()],
            revisions: vec![2; ids.len()],
            states: Some(v1::States {
                row_count: ids.len() as u32,
                coordinates: part.to_vec(),
            }),
            ids,
            payloads: vec![],
        };
        made.push(writer.points(v1::SnapshotPoints {
            modified_revisions: vec![3; points.ids.len()],
            points: Some(points),
        }));
    }
    made.push(writer.trailer());
    made
}

/// A line with two points, and its snapshot.
async fn line(server: &Server) -> Vec<SnapshotPart> {
    let index = server.index("line", "R1").await;
    index.insert([[0.5], [1.5]]).await.unwrap();
    let mut snapshot = index.snapshot().await.unwrap();
    assert_eq!(snapshot.header().point_count, 2);
    let mut parts = Vec::new();
    while let Some(part) = snapshot.next().await.unwrap() {
        parts.push(part);
    }
    parts
}

#[tokio::test]
async fn an_index_goes_from_server_to_server() {
    let (one, other) = (Server::start(), Server::start());
    let index = one.index("line", "R1").await;
    index.insert([[0.5], [1.5]]).ids([3, 9]).await.unwrap();
    let client = other.client().await;
    let snapshot = index.snapshot().await.unwrap();
    let copy = client
        .restore("copy", snapshot.into_stream())
        .await
        .unwrap();
    assert_eq!((copy.name(), copy.revision().number), ("copy", 1));
    let points = copy.get([3, 9]).await.unwrap();
    assert_eq!(points.states().unwrap().coordinates(), [0.5, 1.5]);
    let (copied, original) = (copy.verify().await.unwrap(), index.verify().await.unwrap());
    assert!(copied.agrees() && original.agrees());
    assert_eq!(copied.content_hash, original.content_hash);
    assert_ne!(copied.index.revision.uid, original.index.revision.uid);

    let again = index.snapshot().await.unwrap();
    let taken = client
        .restore("copy", again.into_stream())
        .await
        .unwrap_err();
    assert_eq!(taken.code(), Code::AlreadyExists);
}

#[tokio::test]
async fn a_file_is_written_and_read() {
    let server = Server::start();
    let parts = line(&server).await;
    let mut file = SnapshotWriter::new(Vec::new());
    for part in &parts {
        file.write(part).unwrap();
    }
    let bytes = file.finish().unwrap();
    let reader = SnapshotReader::new(&bytes[..]).unwrap();
    assert_eq!(reader.header().name, "line");
    let read: Result<Vec<_>, _> = reader.collect();
    assert_eq!(read.unwrap(), parts);

    // The reader returns the error once, and then ends.
    let mut reader = SnapshotReader::new(&bytes[..bytes.len() - 1]).unwrap();
    assert!(reader.by_ref().take(2).all(|part| part.is_ok()));
    let cut = reader.next().unwrap().unwrap_err();
    assert!(matches!(cut, SnapshotError::CutShort { parts: 2 }), "{cut}");
    assert!(reader.next().is_none());

    let client = server.client().await;
    let cut = std::io::Cursor::new(bytes[..bytes.len() - 1].to_vec());
    let cut = SnapshotReader::new(cut).unwrap().into_stream();
    let error = client.restore("copy", cut).await.unwrap_err();
    assert!(matches!(error, Error::Snapshot(_)), "{error}");
    let whole = SnapshotReader::new(std::io::Cursor::new(bytes)).unwrap();
    client.restore("copy", whole.into_stream()).await.unwrap();
}

#[tokio::test]
async fn parts_that_end_with_an_error_restore_nothing() {
    let server = Server::start();
    let parts = line(&server).await;
    let client = server.client().await;
    // The call fails even if the client has sent everything before.
    for sent in 0..=parts.len() {
        let failed = Error::Argument {
            field: "source",
            problem: "gone".into(),
        };
        let parts: Vec<_> = parts[..sent].iter().cloned().map(Ok).collect();
        let parts = stream::iter(parts).chain(stream::iter([Err(failed)]));
        let error = client.restore("copy", parts).await.unwrap_err();
        assert_eq!(error.to_string(), "source: gone");
        let missing = client.index("copy").await.unwrap_err();
        assert_eq!(missing.code(), Code::NotFound);
    }
    let parts = stream::iter(parts.into_iter().map(Ok));
    client.restore("copy", parts).await.unwrap();
}

#[tokio::test]
async fn a_server_that_sends_no_good_snapshot_is_found_out() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let good = parts(&[&[1.0], &[2.0, 3.0]]);
    fake.snapshots(&good, true);
    let snapshot = index.snapshot().await.unwrap().into_stream();
    let read: Vec<_> = snapshot.map(|part| part.unwrap().points()).collect().await;
    assert_eq!(read, [0, 1, 2, 0]);

    let mut swapped = good.clone();
    swapped.swap(1, 2);
    for bad in [&[][..], &good[..1], &good[..3], &good[1..], &swapped] {
        fake.snapshots(bad, true);
        let read = async {
            let mut snapshot = index.snapshot().await?;
            while snapshot.next().await?.is_some() {}
            Ok(())
        };
        let error: Error = read.await.unwrap_err();
        assert!(matches!(error, Error::Protocol { .. }), "{error}");
    }
    fake.snapshots(&good[..2], false);
    let patient = index.with_timeout(Duration::from_secs(2));
    let mut snapshot = patient.snapshot().await.unwrap();
    snapshot.next().await.unwrap();
    snapshot.next().await.unwrap();
    let error = snapshot.next().await.unwrap_err();
    assert!(matches!(error, Error::Timeout { .. }), "{error}");
}

#[tokio::test]
async fn a_server_that_takes_nothing_is_not_waited_for() {
    let server = Server::start();
    let parts = line(&server).await;
    let fake = Fake::start().await;
    fake.unavailable(1);
    let whole = || stream::iter(parts.clone().into_iter().map(Ok));
    let error = fake.client().await.restore("copy", whole()).await;
    // The server was starting at first, and then took all parts.
    assert_eq!(error.unwrap_err().code(), Code::Unimplemented);
    let client = wayfold::Client::builder().timeout(Duration::from_secs(2));
    let client = client.connect(&fake.uri).await.unwrap();
    // It hears of the call only.
    fake.fail(|number, _| (number == 0).then(|| tonic::Status::not_found("no such index")));
    fake.fall_silent();
    let error = client.restore("copy", whole()).await.unwrap_err();
    assert_eq!(error.code(), Code::DeadlineExceeded, "{error}");
    let endless = whole()
        .take(1)
        .chain(stream::repeat_with(move || Ok(parts[1].clone())));
    fake.fail(|number, _| (number == 0).then(|| tonic::Status::not_found("no such index")));
    let error = client.restore("copy", endless).await.unwrap_err();
    assert_eq!(error.code(), Code::DeadlineExceeded, "{error}");
}

#[tokio::test]
async fn a_verification_tells_how_far_it_is_and_ends_with_a_report() {
    let server = Server::start();
    let index = server.index("cube", "R3").await;
    let mut states = States::new(3);
    for at in 0..20_000_u32 {
        let x = f64::from(at) / 20_000.0;
        states.push([x, 1.0 - x, x * x]).unwrap();
    }
    index.insert(&states).await.unwrap();
    let mut last = (0, 0);
    let verified = index
        .verify()
        .query_count(40)
        .k(5)
        .seed(3)
        .with_progress(|read, to_read| {
            assert!(last.0 <= read && read <= to_read);
            last = (read, to_read);
        });
    let verified = verified.await.unwrap();
    assert!(verified.agrees(), "{:?}", verified.first_disagreements);
    assert_eq!(
        (verified.stored_point_count, verified.query_count),
        (20_000, 40)
    );
    let refused = index.verify().k(1000).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);

    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let answer = |result| v1::VerifyIndexResponse {
        result: Some(result),
    };
    let progress = answer(Answer::Progress(v1::VerifyProgress::default()));
    let hashless = answer(Answer::Report(v1::VerifyReport::default()));
    for answers in [&[][..], &[progress], &[hashless]] {
        fake.verifies(answers);
        let error = index.verify().await.unwrap_err();
        assert!(matches!(error, Error::Protocol { .. }), "{error}");
    }
}
