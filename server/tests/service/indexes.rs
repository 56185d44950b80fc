//! Creating, describing, listing and deleting indices.

use std::{sync::Arc, time::Duration};

use wayfold_proto::{
    space,
    v1::{self, create_index_request::SpaceForm},
};
use wayfold_server::{
    log::{Catalogue, MemoryLog},
    registry::Registry,
    service::{Code, Error, Limits, Service, Unavailability},
};

use crate::support::*;

fn as_message(space: &str) -> SpaceForm {
    SpaceForm::Space(space::to_message(&space.parse().unwrap()))
}

#[tokio::test]
async fn creating_twice_finds_the_same_index_and_another_space_is_refused() {
    let service = service();
    let first = service
        .create_index(&CALL, creation("arm", "R3*SO3:0.15"))
        .await
        .unwrap();
    assert!(first.created);
    let equal = v1::CreateIndexRequest {
        name: "arm".into(),
        space_form: Some(as_message("R3*RP3:0.15")),
        ..Default::default()
    };
    let second = service.create_index(&CALL, equal).await.unwrap();
    assert!(!second.created);
    assert_eq!(second.index, first.index);

    let other = service.create_index(&CALL, creation("arm", "R3*SO3")).await;
    assert_eq!(
        refusal(other),
        (Code::AlreadyExists, "INDEX_EXISTS", String::new())
    );
}

#[tokio::test]
async fn an_index_keeps_the_payload_encoding_that_it_was_created_with() {
    let service = service();
    let create = |name: &str, encoding: i32| {
        let request = v1::CreateIndexRequest {
            payload_encoding: encoding,
            ..creation(name, "R2")
        };
        let created = service.create_index(&CALL, request);
        async { created.await.map(|it| it.index.unwrap().payload_encoding()) }
    };
    use v1::PayloadEncoding::{Edges, Unspecified, WeightedEdges};
    assert_eq!(create("plain", 0).await.unwrap(), Unspecified);
    assert_eq!(create("plain", 1).await.unwrap(), Unspecified);
    assert_eq!(create("roadmap", 2).await.unwrap(), WeightedEdges);
    assert_eq!(create("roadmap", 0).await.unwrap(), WeightedEdges);
    assert_eq!(
        info(&service, "roadmap").await.payload_encoding(),
        WeightedEdges
    );

    let error = create("roadmap", Edges.into()).await.unwrap_err();
    assert_eq!(error.reason(), "INDEX_EXISTS");
    let text = error.to_string();
    let differ = "index \"roadmap\" exists with the payload encoding PAYLOAD_ENCODING_WEIGHTED_EDGES, \
        not PAYLOAD_ENCODING_EDGES";
    assert!(text.contains(differ), "{text}");
    let unknown = refusal(create("roadmap", 3).await);
    let expected = (Code::InvalidArgument, "UNKNOWN_VALUE", "payload_encoding");
    assert_eq!(unknown, (expected.0, expected.1, expected.2.to_owned()));
}

#[tokio::test]
async fn an_index_describes_itself() {
    let (service, uid) = arm("R3*SO3:0.15").await;
    let index = info(&service, "arm").await;
    assert_eq!(index.space_text, "R3*SO3:0.15");
    assert_eq!(
        space::from_message(&index.space.unwrap())
            .unwrap()
            .to_string(),
        "R3*SO3:0.15"
    );
    assert_eq!((index.coordinate_count, index.dimension), (7, 6));
    assert_eq!(
        (
            index.revision.number(),
            index.point_count,
            index.revision.uid()
        ),
        (0, 0, uid)
    );

    let row = [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]];
    service.insert(&CALL, insertion(&row, &[])).await.unwrap();
    let index = info(&service, "arm").await;
    assert_eq!((index.revision.number(), index.point_count), (1, 1));
    assert!(index.memory_bytes >= 7 * 8);
}

#[tokio::test]
async fn names_spaces_and_tokens_are_checked() {
    let service = service();
    let none = v1::CreateIndexRequest {
        space_form: None,
        ..creation("arm", "")
    };
    let empty = v1::CreateIndexRequest {
        space_form: Some(SpaceForm::Space(v1::Space { kind: None })),
        ..creation("arm", "")
    };
    for (request, reason, field) in [
        (creation("Arm", "R3"), "NAME", "name"),
        (creation("", "R3"), "NAME", "name"),
        (creation("a/b", "R3"), "NAME", "name"),
        (creation(&"a".repeat(64), "R3"), "NAME", "name"),
        (none, "REQUIRED", "space"),
        (creation("arm", ""), "SPACE", "space_text"),
        (creation("arm", "R3*"), "SPACE", "space_text"),
        (creation("arm", "R3:-1"), "SPACE", "space_text"),
        (creation("arm", "R257"), "SPACE", "space_text"),
    ] {
        let refused = refusal(service.create_index(&CALL, request).await);
        assert_eq!(refused, (Code::InvalidArgument, reason, field.into()));
    }
    let (code, reason, field) = refusal(service.create_index(&CALL, empty).await);
    assert_eq!((code, reason), (Code::InvalidArgument, "SPACE"));
    assert!(field.starts_with("space."), "{field}");

    let request = v1::ListIndexesRequest {
        page_token: "nonsense".into(),
        ..Default::default()
    };
    let refused = refusal(service.list_indexes(&CALL, request).await);
    assert_eq!(
        refused,
        (Code::InvalidArgument, "PAGE_TOKEN", "page_token".into())
    );
    assert!(
        service
            .list_indexes(&CALL, Default::default())
            .await
            .unwrap()
            .indexes
            .is_empty()
    );
}

#[tokio::test]
async fn pages_are_in_order_and_survive_a_delete_between_them() {
    let service = service();
    for name in ["e", "c", "a", "d", "b"] {
        create(&service, name, "R1").await;
    }
    let mut names = Vec::new();
    let mut token = String::new();
    loop {
        let request = v1::ListIndexesRequest {
            page_size: 2,
            page_token: token,
        };
        let page = service.list_indexes(&CALL, request).await.unwrap();
        names.extend(page.indexes.into_iter().map(|index| index.name));
        token = page.next_page_token;
        if token.is_empty() {
            break;
        }
        if names.len() == 2 {
            // The index that the token names.
            delete(&service, "b").await;
        }
    }
    assert_eq!(names, ["a", "b", "c", "d", "e"]);
}

/// The service cuts a page size above that.
#[tokio::test]
async fn a_page_has_a_thousand_indices_at_most() {
    let limits = Limits {
        max_indexes: 1001,
        ..Limits::default()
    };
    let service = service_with(Arc::new(MemoryLog::new()), limits);
    for number in 0..1001 {
        create(&service, &format!("{number:04}"), "R1").await;
    }
    let page_of = async |page_token: String| {
        let request = v1::ListIndexesRequest {
            page_size: u32::MAX,
            page_token,
        };
        service.list_indexes(&CALL, request).await.unwrap()
    };
    let first = page_of(String::new()).await;
    assert_eq!(first.indexes.len(), 1000);
    let rest = page_of(first.next_page_token).await.indexes;
    assert_eq!((rest.len(), &*rest[0].name), (1, "1000"));
}

#[tokio::test]
async fn a_page_ends_before_it_outgrows_an_answer() {
    let limits = Limits {
        max_answer_bytes: 400,
        ..Default::default()
    };
    let service = service_with(Arc::new(MemoryLog::new()), limits);
    for name in ["a", "b", "c", "d", "e", "f", "g", "h"] {
        create(&service, name, "R3*SO3:0.15").await;
    }
    let mut names = Vec::new();
    let mut request = v1::ListIndexesRequest::default();
    loop {
        let page = service.list_indexes(&CALL, request).await.unwrap();
        let answer = v1::ListIndexesResponse {
            indexes: page.indexes.clone(),
            next_page_token: page.next_page_token.clone(),
            damaged: vec![],
        };
        assert!(prost::Message::encoded_len(&answer) <= 400);
        names.extend(page.indexes.into_iter().map(|index| index.name));
        if page.next_page_token.is_empty() {
            break;
        }
        request = v1::ListIndexesRequest {
            page_token: page.next_page_token,
            ..Default::default()
        };
    }
    assert_eq!(names.concat(), "abcdefgh");
}

#[tokio::test]
async fn the_log_forgets_deleted_indices() {
    let log = Arc::new(MemoryLog::new());
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    assert_eq!(log.indexes().unwrap().len(), 1);
    delete(&service, "arm").await;
    assert_eq!(log.indexes().unwrap(), []);
}

#[tokio::test]
async fn a_deleted_index_is_gone_and_its_name_starts_a_new_history() {
    let (service, uid) = arm("R1").await;
    insert_rows(&service, &[[1.0]], &[]).await;
    let delete = |uid: &str| v1::DeleteIndexRequest {
        index_name: "arm".into(),
        uid: uid.into(),
    };
    let other = refusal(service.delete_index(&CALL, delete("another")).await);
    assert_eq!(
        other,
        (Code::FailedPrecondition, "UID_MISMATCH", String::new())
    );
    assert_eq!(
        service.delete_index(&CALL, delete(&uid)).await.unwrap().uid,
        uid
    );
    let gone = refusal(service.knn(&CALL, knn(&[[1.0]], 1)).await);
    assert_eq!(gone, (Code::NotFound, "INDEX_NOT_FOUND", String::new()));
    let gone = refusal(service.delete_index(&CALL, delete("")).await);
    assert_eq!(gone, (Code::NotFound, "INDEX_NOT_FOUND", String::new()));
    let request = v1::GetIndexRequest {
        index_name: "arm".into(),
    };
    let gone = refusal(service.get_index(&CALL, request).await);
    assert_eq!(gone, (Code::NotFound, "INDEX_NOT_FOUND", String::new()));

    let again = create(&service, "arm", "R1").await;
    assert_ne!(again, uid);
    assert_eq!(info(&service, "arm").await.point_count, 0);
    let stale = v1::KnnRequest {
        min_revision: revision(&uid, 1),
        ..knn(&[[1.0]], 1)
    };
    let refused = refusal(service.knn(&CALL, stale).await);
    assert_eq!(
        refused,
        (Code::FailedPrecondition, "UID_MISMATCH", String::new())
    );
}

#[tokio::test]
async fn a_wait_for_a_revision_ends_when_the_index_is_deleted() {
    let (service, uid) = arm("R1").await;
    let request = v1::KnnRequest {
        min_revision: revision(&uid, 1),
        ..knn(&[[1.0]], 1)
    };
    let waiting = service.knn(&CALL, request);
    let deleting = async {
        let request = v1::DeleteIndexRequest {
            index_name: "arm".into(),
            uid,
        };
        service.delete_index(&CALL, request).await.unwrap();
    };
    let both = async { tokio::join!(waiting, deleting).0 };
    let answer = tokio::time::timeout(Duration::from_secs(60), both)
        .await
        .unwrap();
    assert_eq!(refusal(answer).1, "INDEX_NOT_FOUND");
}

#[tokio::test]
async fn no_call_is_answered_before_the_service_is_ready_or_after_it_stops() {
    let log = Arc::new(MemoryLog::new());
    let registry = Registry::new(log, options());
    let service = Service::new(registry, Default::default());
    let unavailable = |why| Err(Error::Unavailable { why });
    assert!(!service.is_serving());
    let answer = service.list_indexes(&CALL, Default::default()).await;
    assert_eq!(answer, unavailable(Unavailability::Starting));

    service.set_ready();
    assert!(service.is_serving());
    create(&service, "arm", "R1").await;
    // This call is accepted before the shutdown begins and finishes after it.
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    service.begin_shutdown();
    assert!(!service.is_serving());
    assert_eq!(scan.next().await.unwrap().unwrap().point_count, 0);
    let answer = service.list_indexes(&CALL, Default::default()).await;
    assert_eq!(answer, unavailable(Unavailability::Stopping));
}
