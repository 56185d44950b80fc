//! The bounds on unread answers, calls and scrapes, and the probes of a server whose store is gone.

use std::{
    convert::Infallible,
    fmt,
    future::Future,
    path::Path,
    pin::pin,
    sync::{
        atomic::{AtomicUsize, Ordering::SeqCst},
        mpsc,
    },
};

use bytes::Bytes;
use futures_util::{future::join_all, poll, stream};
use http_body_util::BodyExt;
use parking_lot::Mutex;
use prometheus_client::{collector::Collector, encoding::DescriptorEncoder};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpSocket,
    spawn,
    task::yield_now,
};
use tokio_util::task::AbortOnDropHandle;

use super::*;
use crate::{
    log::{Catalogue, Durability, FjallLog},
    observe::MAX_SCRAPES,
    testing::arm,
    verbs::MAX_DYNAMIC_BYTES,
};

/// Enough for other tasks to begin.
const MOMENT: Duration = Duration::from_millis(10);

#[tokio::test]
async fn an_answer_counts_until_it_is_written() {
    let pages = pages(&service().await, Identities::default());
    let (admission, under_way) = (pages.shared.admission.clone(), pages.under_way.clone());
    let mut router = routes(pages, false);
    for (verb, is_stream) in [
        ("list", false),
        ("arm/scan", false),
        ("arm/points", true),
        ("overview", true),
    ] {
        let request = Request::post(format!("/api/v1/{verb}"));
        let answer = ask(&mut router, request, "{}").await;
        assert_eq!(answer.status(), StatusCode::OK, "{verb}");
        let mut body = answer.into_body();
        let frame: Bytes = body.frame().await.unwrap().unwrap().into_data().unwrap();
        // hyper drops a body once it has its last frame, before it writes it.
        drop(body);
        assert!(admission.bytes().0 >= frame.len() as u64, "{verb}");
        // A stopping server waits for it, unless it is one of a stream.
        assert_eq!(under_way.is_empty(), is_stream, "{verb}");
        drop(frame);
        assert!(under_way.is_empty(), "{verb}");
        assert_eq!(admission.bytes().0, 0, "{verb}");
    }
}

/// Large JSON is written as blocking work, which needs the runtime of a server.
#[tokio::test(flavor = "multi_thread")]
async fn an_answer_counts_until_its_client_reads_it() {
    const ROWS: u32 = 20_000;
    let service = service().await;
    let request = v1::InsertRequest {
        index_name: "arm".into(),
        states: Some(v1::States {
            row_count: ROWS,
            coordinates: (0..2 * ROWS).map(f64::from).collect(),
        }),
        ..Default::default()
    };
    service.insert(&Call::default(), request).await.unwrap();
    let pages = pages(&service, Identities::default());
    let admission = pages.shared.admission.clone();
    // Small buffers: the system takes little of an answer.
    let listener = TcpSocket::new_v4().unwrap();
    listener.set_send_buffer_size(4096).unwrap();
    listener.bind(([127, 0, 0, 1], 0).into()).unwrap();
    let socket = listener.listen(1).unwrap();
    let address = socket.local_addr().unwrap();
    let listener = FaceListener { socket, tls: None };
    let _serving = AbortOnDropHandle::new(spawn(serve(listener, pages)));
    let client = TcpSocket::new_v4().unwrap();
    client.set_recv_buffer_size(4096).unwrap();
    let mut client = client.connect(address).await.unwrap();
    let body = json!({ "include": { "with_states": true } }).to_string();
    let request = format!(
        "POST /api/v1/arm/scan HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    );
    client.write_all(request.as_bytes()).await.unwrap();
    let first = client.read_u8().await.unwrap();
    let held = admission.bytes().0;
    let mut answer = vec![first];
    client.read_to_end(&mut answer).await.unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 200"));
    assert!(answer.len() > 50_000, "{}", answer.len());
    assert!(held > answer.len() as u64 - 1000, "{held}");
    while admission.bytes().0 > 0 {
        yield_now().await;
    }
}

#[tokio::test]
async fn a_call_waits_for_its_place_and_then_needs_room() {
    let pages = pages(&service().await, Identities::default());
    let admission = pages.shared.admission.clone();
    let api = Arc::new(Api::new(&pages, false));
    let list = || {
        let request = Request::post("/api/v1/list").body(Body::empty()).unwrap();
        api::answer(State(Arc::clone(&api)), request)
    };
    for expected in [StatusCode::OK, StatusCode::TOO_MANY_REQUESTS] {
        let others = api.calls.acquire_many(api::MAX_CALLS as u32).await;
        let mut listing = pin!(list());
        for _ in 0..10 {
            assert!(poll!(listing.as_mut()).is_pending());
            yield_now().await;
        }
        let unread = admission.open().hold();
        if expected != StatusCode::OK {
            unread.force_take(admission.bytes().1 as usize + 1);
        }
        drop(others);
        assert_eq!(listing.await.status(), expected);
    }
}

#[tokio::test]
async fn unread_scrapes_leave_no_room_for_more_until_they_are_written() {
    const ROOM: usize = 100_000;
    let pages = pages(&service().await, Identities::default());
    let api = Arc::new(Api::new(&pages, false));
    // A flow that holds much has half of the bytes.
    let others = api.scrapes.hold();
    others.force_take(api.scrapes.max_bytes() / 2 - ROOM);
    let scrape = || {
        let (request, ()) = Request::get("/metrics").body(()).unwrap().into_parts();
        metrics(State(Arc::clone(&api)), request)
    };
    let mut unread = Vec::new();
    let refused = loop {
        let answer = scrape().await;
        if answer.status() != StatusCode::OK {
            break answer.status();
        }
        let frame = answer.into_body().frame().await.unwrap().unwrap();
        unread.push(frame.into_data().unwrap());
        let bytes: usize = unread.iter().map(Bytes::len).sum();
        assert!(bytes <= 2 * ROOM, "{bytes}");
    };
    assert_eq!(refused, StatusCode::TOO_MANY_REQUESTS);
    drop(unread);
    assert_eq!(scrape().await.status(), StatusCode::OK);
}

/// A collector that waits until the sender of its channel is dropped, and counts its looks.
#[derive(Debug)]
struct Stopped {
    until: Mutex<mpsc::Receiver<()>>,
    looks: Arc<AtomicUsize>,
}

impl Collector for Stopped {
    fn encode(&self, _: DescriptorEncoder<'_>) -> fmt::Result {
        self.looks.fetch_add(1, SeqCst);
        // An error means that the sender was dropped.
        let _ = self.until.lock().recv();
        Ok(())
    }
}

/// Routes whose scrapes take until the sender is dropped, and the number of scrapes that have begun.
async fn stopped_scrapes() -> (Router, mpsc::Sender<()>, Arc<AtomicUsize>) {
    let pages = pages(&service().await, Identities::default());
    let (goes_on, until) = mpsc::channel();
    let looks = Arc::new(AtomicUsize::new(0));
    pages.shared.metrics.add(Stopped {
        until: Mutex::new(until),
        looks: Arc::clone(&looks),
    });
    (routes(pages, false), goes_on, looks)
}

fn scrape(router: &Router) -> impl Future<Output = StatusCode> + use<> {
    let mut router = router.clone();
    async move {
        ask(&mut router, Request::get("/metrics"), "")
            .await
            .status()
    }
}

#[tokio::test]
async fn scrapes_whose_callers_left_do_not_queue() {
    let (router, goes_on, looks) = stopped_scrapes().await;
    for _ in 0..20 {
        assert!(timeout(MOMENT, scrape(&router)).await.is_err());
    }
    drop(goes_on);
    assert_eq!(scrape(&router).await, StatusCode::OK);
    assert_eq!(looks.load(SeqCst), 2);
}

#[tokio::test]
async fn few_scrapes_wait() {
    let (router, goes_on, _) = stopped_scrapes().await;
    let scrapes = (0..MAX_SCRAPES).map(|_| Box::pin(scrape(&router)));
    let mut waiting: Vec<_> = scrapes.collect();
    for waiting in &mut waiting {
        assert!(poll!(waiting).is_pending());
    }
    let refused = timeout(Duration::from_secs(10), scrape(&router)).await;
    assert_eq!(refused, Ok(StatusCode::TOO_MANY_REQUESTS));
    drop(goes_on);
    for answered in join_all(waiting).await {
        assert_eq!(answered, StatusCode::OK);
    }
    assert_eq!(scrape(&router).await, StatusCode::OK);
}

async fn metrics_of(router: &mut Router) -> String {
    let answer = ask(router, Request::get("/metrics"), "").await;
    let text = to_bytes(answer.into_body(), usize::MAX).await.unwrap();
    String::from_utf8(text.into()).unwrap()
}

#[tokio::test]
async fn a_wrong_parameter_counts_as_an_invalid_argument() {
    let mut router = router(&service().await, Identities::default());
    let request = Request::post("/api/v1/arm/points?max=x");
    let refused = ask(&mut router, request, "").await;
    assert_eq!(refused.status(), StatusCode::BAD_REQUEST);
    let metrics = metrics_of(&mut router).await;
    let mut calls = metrics
        .lines()
        .filter(|it| it.starts_with("wayfold_call_seconds_count"));
    let counted = calls.next().unwrap();
    assert!(counted.contains("INVALID_ARGUMENT"), "{counted}");
    assert_eq!(calls.next(), None);
}

/// The body comes in two parts. Large JSON is read as blocking work, which needs the runtime of a server.
#[tokio::test(flavor = "multi_thread")]
async fn a_body_has_a_bound() {
    let mut router = router(&service().await, Identities::default());
    for (more, expected) in [(0, StatusCode::OK), (1, StatusCode::BAD_REQUEST)] {
        let mut body = br#"{ "states": [[1.0, 0.5]], "k": 1 }"#.to_vec();
        body.resize(MAX_DYNAMIC_BYTES + more, b' ');
        let parts = body.chunks(MAX_DYNAMIC_BYTES / 2 + 1);
        let parts: Vec<_> = parts
            .map(|part| Ok::<_, Infallible>(part.to_vec()))
            .collect();
        let request = Request::post("/api/v1/arm/knn").header(header::HOST, "127.0.0.1:8080");
        let request: Request<Body> = request
            .body(Body::from_stream(stream::iter(parts)))
            .unwrap();
        let answer = router.call(request).await.unwrap();
        assert_eq!(answer.status(), expected, "{more}");
        let text = to_bytes(answer.into_body(), usize::MAX).await.unwrap();
        let is_too_large = String::from_utf8_lossy(&text).contains("TOO_LARGE");
        assert_eq!(is_too_large, more > 0, "{text:?}");
    }
}

/// A service of a store whose files were lost after its server had written them.
fn unreadable(directory: &Path) -> Service {
    let open = || FjallLog::open(directory, Durability::Fsync).unwrap();
    open().create(arm()).unwrap();
    fs::rename(directory.join("store"), directory.join("elsewhere")).unwrap();
    let registry = Registry::new(Arc::new(open()), RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    service
}

#[tokio::test]
async fn a_server_whose_store_cannot_be_read_is_not_ready() {
    let directory = tempfile::tempdir().unwrap();
    let lifecycle = Lifecycle::starting();
    lifecycle.advance(Phase::Serving);
    let whole = service().await;
    for (service, expected, figure) in [
        (whole, StatusCode::OK, 1),
        (
            unreadable(directory.path()),
            StatusCode::SERVICE_UNAVAILABLE,
            0,
        ),
    ] {
        let pages = Pages {
            phases: lifecycle.watch(),
            ..pages(&service, Identities::default())
        };
        let (shared, phases) = (pages.shared.clone(), pages.phases.clone());
        pages
            .shared
            .metrics
            .add(MetricsCollector { shared, phases });
        let mut router = routes(pages, false);
        let ready = ask(&mut router, Request::get("/readyz"), "").await;
        assert_eq!(ready.status(), expected);
        let line = format!("wayfold_ready{{state=\"reading\"}} {figure}\n");
        assert!(metrics_of(&mut router).await.contains(&line));
    }
}
