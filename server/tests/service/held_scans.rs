//! Scans page by page: all pages read the revision of the first one, as long as it is held.

use std::{sync::Arc, time::Duration};

use wayfold_proto::v1;
use wayfold_server::service::{Call, ClientPermits, Code, Error, Limits, Service};

use crate::support::*;

fn first_page(page_size: u32) -> v1::ScanRequest {
    v1::ScanRequest {
        page_size,
        ..scanning()
    }
}

/// The request for the page after this one.
fn after(request: &v1::ScanRequest, page: &v1::ScanResponse) -> v1::ScanRequest {
    let ids = &page.points.as_ref().unwrap().ids;
    v1::ScanRequest {
        after_id: ids.last().copied(),
        held_scan: page.held_scan.clone(),
        ..request.clone()
    }
}

async fn page(service: &Service, request: &v1::ScanRequest) -> v1::ScanResponse {
    service.scan_page(&CALL, request.clone()).await.unwrap()
}

/// The code and the reason of a page that is refused.
async fn refused(service: &Service, request: &v1::ScanRequest) -> (Code, &'static str) {
    let (code, reason, _) = refusal(service.scan_page(&CALL, request.clone()).await);
    (code, reason)
}

const ENDED: (Code, &str) = (Code::FailedPrecondition, "SCAN_ENDED");

#[tokio::test]
async fn pages_add_up_to_the_held_revision_despite_later_writes() {
    let (service, _) = arm("R3").await;
    let tags: Vec<u64> = (0..5_000).map(|at| at % 2).collect();
    let request = v1::InsertRequest {
        tags,
        ..insertion(&cube(7, 5_000), &[])
    };
    service.insert(&CALL, request).await.unwrap();
    let odd = Some(v1::Filter {
        tag_mask: 1,
        tag_value: 1,
        ..Default::default()
    });
    // The server limits a page to 4096 points, and sets its size where the caller sets none.
    for (page_size, filter, pages) in [
        (0, None, 2),
        (u32::MAX, None, 2),
        (1_250, None, 4),
        (999, odd, 3),
    ] {
        let revision = info(&service, "arm").await.revision;
        let request = v1::ScanRequest {
            filter,
            ..first_page(page_size)
        };
        let mut scan = service.scan(&CALL, request.clone()).await.unwrap();
        let mut expected = Vec::new();
        while let Some(part) = scan.next().await {
            expected.extend(part.unwrap().points.unwrap().ids);
        }
        let (mut next, mut found, mut count) = (request.clone(), Vec::new(), 0);
        loop {
            let found_now = page(&service, &next).await;
            // A retry gets the same page.
            if !found_now.held_scan.is_empty() && !next.held_scan.is_empty() {
                assert_eq!(page(&service, &next).await, found_now);
            }
            assert_eq!(found_now.revision, revision);
            found.extend(found_now.points.clone().unwrap().ids);
            count += 1;
            if found_now.held_scan.is_empty() {
                break;
            }
            next = after(&request, &found_now);
            let gone: Vec<u64> = found.iter().copied().take(10).collect();
            service.remove(&CALL, removal(&gone)).await.unwrap();
            let more = insertion(&cube(count, 10), &[]);
            service.insert(&CALL, more).await.unwrap();
        }
        assert_eq!((found, count), (expected, pages));
        assert_eq!(refused(&service, &next).await, ENDED);
    }
}

/// The test advances the paused clock.
#[tokio::test(start_paused = true)]
async fn a_revision_is_held_for_its_time_while_its_index_lasts() {
    let limits = Limits {
        max_scan_seconds: 100,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    let request = insertion(&cube(1, 10), &[]);
    service.insert(&CALL, request).await.unwrap();
    let request = first_page(3);
    let next = after(&request, &page(&service, &request).await);
    pass(Duration::from_secs(99)).await;
    page(&service, &next).await;
    pass(Duration::from_secs(2)).await;
    assert_eq!(refused(&service, &next).await, ENDED);
    let unknown = v1::ScanRequest {
        held_scan: "another".into(),
        ..request.clone()
    };
    assert_eq!(refused(&service, &unknown).await, ENDED);

    let next = after(&request, &page(&service, &request).await);
    create(&service, "leg", "R3").await;
    let of_another = v1::ScanRequest {
        index_name: "leg".into(),
        ..next.clone()
    };
    assert_eq!(refused(&service, &of_another).await, ENDED);
    delete(&service, "arm").await;
    assert_eq!(refused(&service, &next).await.0, Code::NotFound);
    create(&service, "arm", "R3").await;
    assert_eq!(refused(&service, &next).await, ENDED);
}

/// The test advances the paused clock.
#[tokio::test(start_paused = true)]
async fn held_revisions_are_limited_and_idle_ones_make_room() {
    let limits = Limits {
        max_held_scans: 2,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    let request = insertion(&cube(1, 10), &[]);
    service.insert(&CALL, request).await.unwrap();
    let request = first_page(4);
    let one = after(&request, &page(&service, &request).await);
    let other = after(&request, &page(&service, &request).await);
    let full = service.scan_page(&CALL, request.clone()).await;
    let Err(Error::LimitExceeded { limit, value, .. }) = full else {
        panic!("{full:?}");
    };
    assert_eq!((limit, value), ("max_held_scans", 2));
    // A scan of one page holds nothing.
    assert_eq!(page(&service, &first_page(10)).await.held_scan, "");

    pass(Duration::from_secs(20)).await;
    page(&service, &one).await;
    pass(Duration::from_secs(11)).await;
    let third = after(&request, &page(&service, &request).await);
    assert_eq!(refused(&service, &other).await, ENDED);
    let last = after(&request, &page(&service, &one).await);
    assert_eq!(page(&service, &last).await.held_scan, "");
    // The end of a scan frees its place.
    page(&service, &request).await;
    page(&service, &third).await;
}

#[tokio::test]
async fn one_caller_does_not_keep_others_from_scanning() {
    let limits = Limits {
        max_held_scans: 4,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    let request = insertion(&cube(1, 10), &[]);
    service.insert(&CALL, request).await.unwrap();
    let request = first_page(4);
    let [greedy, other] = [(); 2].map(|()| Call {
        permits: Some(Arc::new(ClientPermits::new(1))),
        ..Call::default()
    });
    let scan = async |call: &Call, request: &v1::ScanRequest| {
        let page = service.scan_page(call, request.clone()).await?;
        Ok::<_, Error>(after(request, &page))
    };
    let mut scans = Vec::new();
    for _ in 0..4 {
        scans.push(scan(&greedy, &request).await.unwrap());
    }
    scan(&greedy, &request).await.unwrap_err();
    // The oldest ones of the greedy caller go, until both hold the same number.
    for _ in 0..2 {
        scans.push(scan(&other, &request).await.unwrap());
    }
    for call in [&greedy, &other] {
        let refused = refusal(service.scan_page(call, request.clone()).await);
        assert_eq!(refused.1, "LIMIT_EXCEEDED");
    }
    for (number, next) in scans.iter().enumerate() {
        match number {
            0 | 1 => assert_eq!(refused(&service, next).await, ENDED),
            _ => drop(page(&service, next).await),
        }
    }
}
