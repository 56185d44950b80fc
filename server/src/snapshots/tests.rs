use tempfile::NamedTempFile;

use super::*;
use crate::testing::{arm, log_with, server};

fn schedule(directory: &Path, keep: usize) -> Schedule {
    Schedule {
        directory: directory.to_owned(),
        every: HOUR,
        keep,
        disk: None,
        _lock: tempfile::tempfile().unwrap(),
    }
}

const HOUR: Duration = Duration::from_secs(3600);

/// 2026-01-31T23:59:59Z.
fn now() -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_769_903_999)
}

/// A service with the index `arm`.
fn service() -> Service {
    let log = log_with(&arm(), &[]);
    server(&log, &log)
}

#[test]
fn a_snapshot_is_due_after_its_time_if_the_content_is_another() {
    let schedule = schedule(Path::new("unused"), 1);
    let content = "-uid-7.snapshot";
    let due = |before: &[&str]| {
        let before: Vec<String> = before.iter().map(|name| (*name).into()).collect();
        schedule.is_due(&before, content, now())
    };
    assert!(due(&[]));
    assert!(due(&["20260131T225959Z-uid-6.snapshot"]));
    assert!(due(&["20260131T225959Z-other-7.snapshot"]));
    assert!(!due(&["20260131T225959Z-uid-7.snapshot"]));
    assert!(!due(&["20260131T230000Z-uid-6.snapshot"]));
    // The clock was put back: one is due, and the next after its time.
    let future = "20270131T230000Z-uid-6.snapshot";
    assert!(due(&[future]));
    assert!(!due(&["20260131T235900Z-uid-5.snapshot", future]));
}

#[cfg(unix)]
#[test]
fn a_directory_is_in_the_data_by_its_place_and_not_by_its_name() {
    let directory = tempfile::tempdir().unwrap();
    let [data, link] = ["data", "link"].map(|name| directory.path().join(name));
    std::os::unix::fs::symlink(&data, &link).unwrap();
    let beside = data.join("../snapshots");
    // The first start makes the directory of the data later.
    assert!(!is_within(&beside, &data));
    fs::create_dir(&data).unwrap();
    assert!(!is_within(&beside, &data));
    assert!(is_within(&data.join("snapshots"), &data));
    assert!(is_within(&link.join("snapshots"), &data));
    assert!(is_within(&data, &link));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_snapshot_leaves_the_room_of_the_disk_free() {
    let service = service();
    let hosted = service.opened().unwrap().get("arm").unwrap();
    let directory = tempfile::tempdir().unwrap();
    let full = || {
        Ok(watermark::Usage {
            used: 90,
            high: 85,
            low: 80,
            limit: 100,
        })
    };
    let disk = Watermark::new(watermark::Resource::Disk, full);
    let schedule = Schedule {
        disk: Some(Arc::new(disk)),
        ..schedule(directory.path(), 1)
    };
    let runtime = Handle::current();
    let taken = move || schedule.take_one(&service, &runtime, &hosted, now());
    let taken = tokio::task::spawn_blocking(taken).await.unwrap();
    assert!(matches!(taken, Err(Failure::Full { .. })), "{taken:?}");
    let left = fs::read_dir(directory.path().join("arm")).unwrap().count();
    assert_eq!(left, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_index_that_was_deleted_after_the_list_was_made_is_no_failure() {
    let service = service();
    let hosted = service.opened().unwrap().get("arm").unwrap();
    let deletion = v1::DeleteIndexRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let deleted = service.delete_index(&Call::default(), deletion).await;
    deleted.unwrap();
    let directory = tempfile::tempdir().unwrap();
    let schedule = schedule(directory.path(), 1);
    let runtime = Handle::current();
    let taken = move || schedule.take_one(&service, &runtime, &hosted, now());
    let taken = tokio::task::spawn_blocking(taken).await.unwrap();
    assert!(matches!(taken, Ok(None)), "{taken:?}");
}

/// Two snapshots fail: their directory is a file.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn snapshots_are_counted_by_their_outcome() {
    let (service, metrics, runtime) = (service(), Metrics::new(true), Handle::current());
    let (file, directory) = (NamedTempFile::new().unwrap(), tempfile::tempdir().unwrap());
    let schedules = [file.path(), file.path(), directory.path()].map(|path| schedule(path, 1));
    let counted = metrics.clone();
    let looks = move || schedules.map(|it| it.take_due(&service, &metrics, &runtime, now()));
    tokio::task::spawn_blocking(looks).await.unwrap();
    let text = counted.text().unwrap();
    for (outcome, count) in [("failed", 2), ("written", 1)] {
        let line = format!("wayfold_snapshots_total{{outcome=\"{outcome}\"}} {count}\n");
        assert!(text.contains(&line), "{text}");
    }
}
