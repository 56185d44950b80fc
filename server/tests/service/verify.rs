//! Verification accepts sound data and finds damage.

use std::sync::Arc;

use sha2::{Digest, Sha256};
use wayfold_proto::v1;
use wayfold_server::{
    log::{
        LogError, MemoryLog, PointStore, Record, RecordPosition, Sessions, StoredPoint, Uid, View,
    },
    service::{Code, Service},
};

use crate::{
    forward::{forward_catalogue, forward_points, forward_whole_journal},
    support::{snapshots::*, *},
};

/// The documented hash of the points that a scan returns.
async fn content_hash(service: &Service, space: &str) -> Vec<u8> {
    hash_of(&everything(service).await.points.unwrap(), space)
}

/// The hash as documented, of all points of an index.
pub(crate) fn hash_of(points: &v1::Points, space: &str) -> Vec<u8> {
    let rows = &points.states.as_ref().unwrap().coordinates;
    let mut bytes = b"wayfold content 1".to_vec();
    bytes.extend((space.len() as u64).to_le_bytes());
    bytes.extend(space.bytes());
    for (at, id) in points.ids.iter().enumerate() {
        let width = rows.len() / points.ids.len();
        bytes.extend(id.to_le_bytes());
        bytes.extend(points.tags[at].to_le_bytes());
        rows[at * width..][..width]
            .iter()
            .for_each(|x| bytes.extend(x.to_le_bytes()));
        bytes.extend((points.payloads[at].len() as u64).to_le_bytes());
        bytes.extend(&points.payloads[at]);
    }
    Sha256::digest(&bytes).to_vec()
}

#[tokio::test]
async fn sound_data_is_accepted() {
    for (seed, space) in ["R1", "SO2[1]", "R2*SO2", "R3*SO3:0.15", "sum(R2, SO3)"]
        .into_iter()
        .enumerate()
    {
        let service = service();
        lived_in(&service, space, seed as u64).await;
        let request = v1::VerifyIndexRequest {
            query_count: Some(101),
            k: Some(7),
            seed: seed as u64,
            ..verification()
        };
        let report = verify(&service, request).await.unwrap();
        let index = described(&service, "arm").await;
        assert_eq!(report.first_disagreements, Vec::<String>::new(), "{space}");
        assert_eq!((report.disagreement_count, report.query_count), (0, 101));
        assert_eq!(report.stored_point_count, index.point_count);
        assert_eq!(report.content_hash, content_hash(&service, space).await);
        assert_eq!(settled(report.index.unwrap()), index);
    }
}

#[tokio::test]
async fn an_index_without_points_and_one_without_queries_are_verified() {
    let (service, _) = arm("R3*SO3:0.15").await;
    let report = verify(&service, verification()).await.unwrap();
    assert_eq!(
        (report.disagreement_count, report.stored_point_count),
        (0, 0)
    );
    assert_eq!(report.query_count, 32);
    let none = v1::VerifyIndexRequest {
        query_count: Some(0),
        ..verification()
    };
    let bare = verify(&service, none).await.unwrap();
    assert_eq!(bare.content_hash, report.content_hash);
    assert_eq!(bare.query_count, 0);
}

#[tokio::test]
async fn the_hash_is_the_contents_and_not_the_pasts() {
    let (one, _) = arm("R1").await;
    let (other, _) = arm("R1").await;
    one.insert(&CALL, insertion(&[[0.0], [1.0]], &[4, 5]))
        .await
        .unwrap();
    insert_rows(&other, &[[1.0], [7.0]], &[5, 9]).await;
    other.remove(&CALL, removal(&[9])).await.unwrap();
    let hash = async |service| verify(service, verification()).await.unwrap().content_hash;
    assert_ne!(hash(&one).await, hash(&other).await);
    insert_rows(&other, &[[0.0]], &[4]).await;
    assert_eq!(hash(&one).await, hash(&other).await);
    let tagged = v1::UpdateRequest {
        tags: vec![1],
        ..updating(&[4])
    };
    other.update(&CALL, tagged).await.unwrap();
    assert_ne!(hash(&one).await, hash(&other).await);
}

#[tokio::test]
async fn the_parameters_of_a_verification_are_bounded() {
    let (service, _) = arm("R1").await;
    for (query_count, k, field) in [
        (Some(1001), None, "query_count"),
        (None, Some(0), "k"),
        (None, Some(101), "k"),
    ] {
        let request = v1::VerifyIndexRequest {
            query_count,
            k,
            ..verification()
        };
        let refused = refusal(verify(&service, request).await);
        let expected = (Code::InvalidArgument, "OUT_OF_RANGE", field.to_owned());
        assert_eq!(refused, expected);
    }
    let elsewhere = v1::VerifyIndexRequest {
        index_name: "leg".into(),
        ..verification()
    };
    assert_eq!(refusal(verify(&service, elsewhere).await).0, Code::NotFound);
}

/// The fault of a view: the stored point in, the returned point out.
type ReadFault = fn(Arc<StoredPoint>) -> Result<Option<Arc<StoredPoint>>, LogError>;

/// A log whose views return wrong points.
struct FaultyLog(MemoryLog, ReadFault);

struct FaultyView(Arc<dyn View>, ReadFault);

impl View for FaultyView {
    fn position(&self) -> RecordPosition {
        self.0.position()
    }

    fn next_id(&self) -> u64 {
        self.0.next_id()
    }

    fn sessions(&self) -> &Sessions {
        self.0.sessions()
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        self.0.get(id)
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let page = self.0.page(after, limit)?;
        page.into_iter()
            .filter_map(|point| (self.1)(point).transpose())
            .collect()
    }
}

forward_catalogue!(FaultyLog, 0);
forward_whole_journal!(FaultyLog, 0);

impl PointStore for FaultyLog {
    forward_points!(0);

    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        Ok(Arc::new(FaultyView(self.0.apply(uid, records)?, self.1)))
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        Ok(Arc::new(FaultyView(self.0.view(uid)?, self.1)))
    }
}

async fn lying(lie: ReadFault) -> Service {
    let service = over(Arc::new(FaultyLog(MemoryLog::new(), lie)));
    create(&service, "arm", "R3").await;
    let rows = cube(3, 1000);
    service.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    service
}

/// Returns the last point under another id.
fn moved(point: Arc<StoredPoint>) -> Result<Option<Arc<StoredPoint>>, LogError> {
    let mut point = (*point).clone();
    if point.id == 999 {
        point.id = 10_000;
    }
    Ok(Some(Arc::new(point)))
}

/// Changes the point with id 500.
fn changed(
    point: Arc<StoredPoint>,
    change: impl FnOnce(&mut StoredPoint),
) -> Result<Option<Arc<StoredPoint>>, LogError> {
    let mut point = (*point).clone();
    if point.id == 500 {
        change(&mut point);
    }
    Ok(Some(Arc::new(point)))
}

#[tokio::test]
async fn a_point_that_differs_is_found_and_named() {
    let lies: [(ReadFault, &str); 6] = [
        (
            |point| Ok((point.id != 500).then_some(point)),
            "id 500 is searched and not stored",
        ),
        (moved, "id 10000 is stored and not searched"),
        (
            |point| changed(point, |point| point.tag = 9),
            "id 500 is searched with the tag 0, stored 9",
        ),
        (
            |point| changed(point, |point| point.revision = 2),
            "id 500 is searched with revision 1, stored 2",
        ),
        (
            |point| changed(point, |point| point.state[1] = 0.5),
            "id 500 is searched with the state",
        ),
        (
            |point| changed(point, |point| point.state = [0.5].into()),
            "id 500 is searched with the state",
        ),
    ];
    for (lie, words) in lies {
        let service = lying(lie).await;
        let none = v1::VerifyIndexRequest {
            query_count: Some(0),
            ..verification()
        };
        let report = verify(&service, none).await.unwrap();
        assert!(report.disagreement_count > 0, "{words}");
        let disagreements = report.first_disagreements.join("; ");
        assert!(disagreements.contains(words), "{words}: {disagreements}");
        // A verification with queries finds the fault too.
        assert!(
            verify(&service, verification())
                .await
                .unwrap()
                .disagreement_count
                > 0
        );
    }
}

#[tokio::test]
async fn an_answer_that_differs_is_found() {
    // Each point is moved slightly, so that brute force finds it and the forest does not.
    let service = lying(|point| {
        let mut point = (*point).clone();
        point.state[0] += 1e-9;
        Ok(Some(Arc::new(point)))
    })
    .await;
    let report = verify(&service, verification()).await.unwrap();
    // The count includes a thousand points and both answers to each query.
    assert_eq!(report.disagreement_count, 1000 + 2 * 32);
    assert_eq!(report.first_disagreements.len(), 10);
}

#[tokio::test]
async fn stored_points_that_cannot_be_read_are_data_loss() {
    let service = lying(|point| match point.id {
        700 => Err(LogError::damaged_point(
            Uid::unique(),
            700,
            "it does not match its checksum",
        )),
        _ => Ok(Some(point)),
    })
    .await;
    let error = verify(&service, verification()).await.unwrap_err();
    assert_eq!(error.code(), Code::DataLoss);
    assert!(error.to_string().contains("\"arm\""), "{error}");
    let request = v1::SnapshotIndexRequest {
        index_name: "arm".into(),
        min_revision: None,
    };
    let mut snapshot = service.snapshot_index(&CALL, request).await.unwrap();
    snapshot.next().await.unwrap().unwrap();
    let error = snapshot.next().await.unwrap().unwrap_err();
    assert_eq!(error.code(), Code::DataLoss);
}

#[tokio::test]
async fn a_snapshot_that_lacks_points_is_not_finished() {
    let service = lying(|point| Ok((point.id != 500).then_some(point))).await;
    let request = v1::SnapshotIndexRequest {
        index_name: "arm".into(),
        min_revision: None,
    };
    let mut snapshot = service.snapshot_index(&CALL, request).await.unwrap();
    let mut last = None;
    while let Some(part) = snapshot.next().await {
        last = Some(part);
    }
    let error = last.unwrap().unwrap_err();
    assert_eq!(error.code(), Code::DataLoss);
    assert!(
        error.to_string().contains("1000 points, of which 999"),
        "{error}"
    );
}
