//! Any integers in the payload or the parameters of a query get an answer or a refusal.

use prost::Message;
use prost_reflect::{DynamicMessage, Kind, ReflectMessage, Value};

use super::*;
use crate::{
    extremes::{EXTREMES, requests, variants},
    own_index::own_index,
    quiet::{deadline, quietly, two_points},
    service::{Call, Code, Service},
    verbs::{
        Target,
        codec::{parameters::SHORT, write},
        dispatch,
        verb::Verb,
    },
};

/// The key and the request message of each verb. The length is that of the lists of all verbs.
const VERBS: [(&str, &str); Verb::OF_INDEX.len() + Verb::OF_SERVER.len()] = [
    ("server", "GetServerRequest"),
    ("arm/knn", "KnnRequest"),
    ("arm/query", "QueryRequest"),
    ("arm/insert", "InsertRequest"),
    ("arm/update", "UpdateRequest"),
    ("arm/remove", "RemoveRequest"),
    ("arm/session", "OpenSessionRequest"),
    ("arm/write", "WriteRequest"),
    ("arm/get", "GetRequest"),
    ("arm/scan", "ScanRequest"),
    ("arm/info", "GetIndexRequest"),
    ("arm/log", "WatchRequest"),
    ("create", "CreateIndexRequest"),
    ("list", "ListIndexesRequest"),
    ("delete", "DeleteIndexRequest"),
];

async fn answer(service: &Service, key: &str, request: &Request<'_>) -> Result<(), Error> {
    let key = format!("wayfold/v1/{key}");
    let target = Target::of("wayfold/v1", &key).unwrap();
    let call = Call {
        deadline: Some(deadline()),
        ..Call::default()
    };
    // Waits end at once: the test runs in paused time.
    quietly(dispatch(service, &call, target.verb, request, 1 << 20))
        .await
        .map(drop)
}

async fn assert_answered(service: &Service, key: &str, request: &Request<'_>) {
    if let Err(error) = answer(service, key, request).await {
        let is_conflict = error.to_string().contains("disagree");
        let is_bug = is_conflict || matches!(error.code(), Code::Internal | Code::DataLoss);
        assert!(!is_bug, "{key} {:?}: {error}", request.parameters);
    }
}

fn request_in<'a>(form: Form, key: &'a str, message: &DynamicMessage) -> Request<'a> {
    let payload = match form {
        Form::Protobuf => message.encode_to_vec(),
        Form::Json => write::json(message).into_bytes(),
    };
    Request {
        form,
        index: key.split_once('/').map_or("", |(index, _)| index),
        parameters: Vec::new(),
        payload: payload.into(),
    }
}

/// In JSON, states are rows. Their number is the length of the list, not a field.
fn count_rows(message: &mut DynamicMessage) {
    if let Some(Value::Message(states)) = message.get_field_by_name_mut("states")
        && states.has_field_by_name("row_count")
    {
        states.set_field_by_name("row_count", Value::U32(1));
    }
}

/// The parameters of a message, the short ones too, and the field that each sets or sets a part of.
fn parameters(message: &DynamicMessage) -> Vec<(String, String)> {
    let descriptor = message.descriptor();
    let fields = descriptor.fields();
    let fields = fields.filter(|field| !matches!(field.kind(), Kind::Message(_) | Kind::Bytes));
    let own = fields.map(|field| (field.name().to_owned(), field.name().to_owned()));
    let short = SHORT.iter().filter_map(|(short, full)| {
        let field = full.split('.').next()?;
        descriptor.get_field_by_name(field)?;
        Some(((*short).to_owned(), field.to_owned()))
    });
    own.chain(short).collect()
}

#[tokio::test(start_paused = true)]
async fn every_verb_answers_or_refuses_whatever_integers_it_is_asked_with() {
    let (service, uid) = two_points().await;
    let requests = requests(&uid);
    for (key, name) in VERBS {
        let of_verb = |request: &&DynamicMessage| request.descriptor().name() == name;
        let good: Vec<_> = requests.iter().filter(of_verb).collect();
        assert!(!good.is_empty(), "{key}");
        for form in [Form::Protobuf, Form::Json] {
            for good in &good {
                for (at, (what, mut variant)) in variants(good).into_iter().enumerate() {
                    println!("{what}, {form:?}");
                    let mut service = service.clone();
                    if let Some(own) = own_index(good, at).await {
                        (service, variant) = own;
                    }
                    if form == Form::Json {
                        count_rows(&mut variant);
                    }
                    let request = request_in(form, key, &variant);
                    assert_answered(&service, key, &request).await;
                }
                for (parameter, field) in parameters(good) {
                    let mut rest = (*good).clone();
                    rest.clear_field_by_name(&field);
                    for text in EXTREMES
                        .map(|integer| integer.to_string())
                        .iter()
                        .map(|it| &**it)
                        .chain(["-1", "18446744073709551616", "1e30", "0x10", ""])
                    {
                        println!("{name}, {parameter}={text}, {form:?}");
                        let mut request = request_in(form, key, &rest);
                        if form == Form::Json {
                            // JSON names fields with their default values too.
                            let mut json: serde_json::Value =
                                serde_json::from_slice(&request.payload).unwrap();
                            json.as_object_mut().unwrap().remove(&field);
                            request.payload = json.to_string().into_bytes().into();
                        }
                        request.parameters.push((&parameter, text));
                        if parameter == "from" {
                            request.parameters.push(("uid", &uid));
                        }
                        assert_answered(&service, key, &request).await;
                    }
                }
            }
        }
    }
}

/// The requests that the other test varies are good ones, in both forms.
#[tokio::test(start_paused = true)]
async fn every_verb_answers_a_good_request() {
    for (key, name) in VERBS {
        for form in [Form::Protobuf, Form::Json] {
            for at in 0.. {
                // A request may change the index, so that the next one is refused.
                let (service, uid) = two_points().await;
                let requests = requests(&uid);
                let of_verb = |request: &&DynamicMessage| request.descriptor().name() == name;
                let Some(good) = requests.iter().filter(of_verb).nth(at) else {
                    assert!(at > 0, "{key}");
                    break;
                };
                let answered = answer(&service, key, &request_in(form, key, good)).await;
                match (name, answered) {
                    // It names another uid.
                    ("DeleteIndexRequest", Err(error)) => {
                        assert_eq!(error.code(), Code::FailedPrecondition);
                    }
                    (_, answered) => answered.unwrap(),
                }
            }
        }
    }
}

/// Empty payloads of an insert, and empty spaces of a new index.
#[tokio::test]
async fn requests_that_grow_by_decoding_are_refused_before_it() {
    let (service, _) = two_points().await;
    for (key, field, count) in [("arm/insert", 0x2a, 401_000), ("create", 0x12, 600_000)] {
        let request = Request {
            form: Form::Protobuf,
            index: "arm",
            parameters: Vec::new(),
            payload: [field, 0].repeat(count).into(),
        };
        let refused = answer(&service, key, &request).await.unwrap_err();
        assert!(matches!(refused, Error::LimitExceeded { .. }), "{refused}");
    }
}

#[test]
fn a_long_timeout_counts_as_a_minute() {
    let now = Instant::now();
    let deadline = |timeout: &str| {
        let named = [(TIMEOUT, timeout)];
        let request = Request::of(Form::Json, "arm", named, Cow::default(), now);
        request.unwrap().1
    };
    let most = Some(now + Duration::from_secs(60));
    assert_eq!(deadline("59000"), Some(now + Duration::from_secs(59)));
    assert_eq!(deadline("60000"), most);
    assert_eq!(deadline("1000000000000"), most);
    assert_eq!(deadline(&u64::MAX.to_string()), most);
}
