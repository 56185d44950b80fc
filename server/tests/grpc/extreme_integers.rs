//! Every method of both services answers its good requests, and answers or refuses each extreme integer with a status of
//! its own. The methods of points spin in no wait.

use std::time::{Duration, Instant};

use bytes::{Buf, BufMut, Bytes, BytesMut};
use futures_util::stream;
use prost::Message;
use prost_reflect::{DynamicMessage, MethodDescriptor, ReflectMessage, Value};
use tonic::{Code, Request, Status, client::Grpc, transport::Channel};
use wayfold_proto::v1;
use wayfold_server::{InProcess, config::Config};

use crate::{
    extremes::{pool, requests, variants},
    harness::{TestServer, insert, uid_of},
    own_index::own_index,
    quiet::{deadline, quietly, two_points},
    raw::Raw,
};

/// The timeout of a call that may wait for a revision that does not exist.
const WAIT: Duration = Duration::from_millis(20);

/// The timeout of a call that must be answered before it.
const NEVER: Duration = Duration::from_secs(3600);

/// The greatest revision that the index has before the first call.
const NEWEST: u64 = 3;

/// The methods of a service, or of all, that take such a message.
fn methods<'a>(
    all: &'a [MethodDescriptor],
    request: &DynamicMessage,
) -> impl Iterator<Item = &'a MethodDescriptor> {
    let name = request.descriptor().full_name().to_owned();
    all.iter()
        .filter(move |method| method.input().full_name() == name)
}

/// True if a call may wait for a revision that the index does not have.
fn may_wait(request: &DynamicMessage) -> bool {
    match request.descriptor().name() {
        "WatchRequest" => true,
        // The neighbours of an insert are those at its own revision.
        "InsertRequest" => false,
        _ => request.fields().any(|(field, value)| match value {
            Value::Message(revision)
                if ["min_revision", "since_revision"].contains(&field.name()) =>
            {
                let number = revision.get_field_by_name("number").unwrap();
                number.as_u64().unwrap() > NEWEST
            }
            Value::Message(within) => may_wait(within),
            _ => false,
        }),
    }
}

/// The number of answers of a call, and its status.
struct Answered {
    count: usize,
    status: Status,
}

impl Answered {
    /// Takes an answer. One of `StreamKnn` can hold an error.
    fn add(&mut self, method: &MethodDescriptor, answer: &[u8]) {
        let answer = DynamicMessage::decode(method.output(), answer).unwrap();
        self.count += 1;
        let error = answer.descriptor().get_field_by_name("error");
        if let Some(error) = error.filter(|error| answer.has_field(error)) {
            let error = answer.get_field(&error);
            let error: v1::Status = error.as_message().unwrap().transcode_to().unwrap();
            self.status = Status::new(error.code.into(), error.message);
        }
    }

    /// Asserts that a good request is answered. A watch goes on until its deadline.
    fn assert_good(&self, request: &str) {
        let expected = match request {
            "WatchRequest" => Code::DeadlineExceeded,
            // It names the uid of another index.
            "DeleteIndexRequest" => {
                return assert_eq!(self.status.code(), Code::FailedPrecondition);
            }
            _ => Code::Ok,
        };
        assert_eq!(self.status.code(), expected, "{request}: {}", self.status);
        assert!(self.count > 0, "{request}");
    }

    /// Asserts that a request is answered or refused for a reason of its own.
    fn assert_answered_or_refused(&self, may_wait: bool) {
        let is_bug = match self.status.code() {
            Code::Ok => self.count == 0,
            Code::DeadlineExceeded | Code::Cancelled => !may_wait,
            Code::Internal | Code::Unknown | Code::DataLoss => true,
            Code::Unavailable | Code::Unimplemented => true,
            _ => false,
        };
        assert!(!is_bug, "{} answers, {:?}", self.count, self.status);
    }
}

/// Calls a method, streaming or not, and reads all of its answers; of a good watch the first one.
async fn call(
    channel: &Channel,
    method: &MethodDescriptor,
    message: &impl Message,
    timeout: Duration,
) -> Answered {
    let service = method.parent_service().full_name();
    let path = format!("/{service}/{}", method.name());
    let mut request = Request::new(stream::iter([message.encode_to_vec()]));
    request.set_timeout(timeout);
    let mut client = Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let mut answered = Answered {
        count: 0,
        status: Status::ok(""),
    };
    let answers = client.streaming(request, path.parse().unwrap(), Raw).await;
    let mut answers = match answers {
        Ok(answers) => answers.into_inner(),
        Err(status) => return Answered { status, ..answered },
    };
    loop {
        match answers.message().await {
            Ok(Some(answer)) => answered.add(method, &answer),
            Ok(None) => return answered,
            Err(status) => return Answered { status, ..answered },
        }
        if timeout == NEVER && method.name() == "Watch" {
            let status = Status::deadline_exceeded("it would wait");
            return Answered { status, ..answered };
        }
    }
}

#[tokio::test]
async fn every_method_answers_or_refuses_extreme_integers() {
    let server = TestServer::start(|_| ()).await;
    let uid = uid_of(&server.create_line("arm").await);
    for coordinate in [0.0, 1.0] {
        let request = insert("arm", &[coordinate]);
        server.points().insert(request).await.unwrap();
    }
    let session = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    server.points().open_session(session).await.unwrap();
    let requests = requests(&uid);
    let pool = pool();
    let all: Vec<_> = pool
        .services()
        .flat_map(|it| it.methods().collect::<Vec<_>>())
        .collect();
    for method in &all {
        let takes = |request: &DynamicMessage| methods(&all, request).any(|it| it == method);
        // The suite of the service tries it.
        let is_tried = method.name() == "RestoreIndex" || requests.iter().any(takes);
        assert!(is_tried, "{} is not tried", method.full_name());
    }
    for request in &requests {
        for method in methods(&all, request) {
            let answered = call(&server.channel, method, request, NEVER).await;
            answered.assert_good(request.descriptor().name());
        }
    }
    for (what, variant) in requests.iter().flat_map(variants) {
        println!("{what}");
        let may_wait = may_wait(&variant);
        let timeout = if may_wait { WAIT } else { NEVER };
        for method in methods(&all, &variant) {
            let answered = call(&server.channel, method, &variant, timeout).await;
            answered.assert_answered_or_refused(may_wait);
        }
    }
}

/// Makes a call of `PointService` without a connection, and asserts that it does not spin.
async fn call_in_process(
    calls: &mut InProcess,
    method: &MethodDescriptor,
    message: &DynamicMessage,
) -> Answered {
    let message = message.encode_to_vec();
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.len() as u32);
    frame.put_slice(&message);
    let service = method.parent_service().full_name();
    let timeout = deadline() - Instant::now();
    let request = http::Request::post(format!("/{service}/{}", method.name()))
        .header("content-type", "application/grpc")
        .header("grpc-timeout", format!("{}S", timeout.as_secs()))
        .body(frame.freeze())
        .unwrap();
    let (mut answers, status): (Bytes, _) = quietly(calls.call(request)).await;
    let mut answered = Answered { count: 0, status };
    while answers.has_remaining() {
        assert_eq!(answers.get_u8(), 0, "the answer is compressed");
        let length = answers.get_u32() as usize;
        answered.add(method, &answers.split_to(length));
    }
    answered
}

/// A waiting call ends at its deadline, and a watch checks its rights each second until then. The clock of the test is paused, so
/// the deadline comes at once.
#[tokio::test(start_paused = true)]
async fn no_method_of_points_spins_on_extreme_integers() {
    let (service, uid) = two_points().await;
    let points = pool().get_service_by_name("wayfold.v1.PointService");
    let points: Vec<_> = points.unwrap().methods().collect();
    let mut calls = InProcess::new(&Config::default(), service, None).unwrap();
    let good = requests(&uid);
    for request in &good {
        for method in methods(&points, request) {
            let answered = call_in_process(&mut calls, method, request).await;
            answered.assert_good(request.descriptor().name());
        }
    }
    for request in &good {
        let (mut taken, mut is_shared) = (0, true);
        for (at, (what, mut variant)) in variants(request).into_iter().enumerate() {
            println!("{what}");
            if let Some((service, own)) = own_index(request, at).await {
                calls = InProcess::new(&Config::default(), service, None).unwrap();
                (variant, is_shared) = (own, false);
            }
            for method in methods(&points, &variant) {
                let answered = call_in_process(&mut calls, method, &variant).await;
                answered.assert_answered_or_refused(may_wait(&variant));
                taken += usize::from(answered.status.code() == Code::Ok);
            }
        }
        assert!(taken > 1 || is_shared, "{request:?}");
    }
}
