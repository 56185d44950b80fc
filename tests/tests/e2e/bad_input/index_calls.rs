//! Bad fields of the calls of `IndexService`.

use tonic::Code::{self, AlreadyExists, FailedPrecondition, InvalidArgument, NotFound};
use wayfold_proto::v1::{
    Composition, CreateIndexRequest, DeleteIndexRequest, GetIndexRequest, ListIndexesRequest,
    Product, RealVector, So2, Space, Term, create_index_request::SpaceForm, space::Kind,
};

use super::{Bench, INDEX};

fn space(kind: Kind) -> Space {
    Space { kind: Some(kind) }
}

fn product(composition: Composition, terms: Vec<(Option<Space>, Option<f64>)>) -> Space {
    let terms = terms.into_iter();
    space(Kind::Product(Product {
        composition: composition.into(),
        terms: terms
            .map(|(space, weight)| Term { space, weight })
            .collect(),
    }))
}

#[tokio::test]
async fn bad_indices_are_refused() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.indexes.clone();
    let named = |name: &str, text: &str| CreateIndexRequest {
        name: name.into(),
        space_form: Some(SpaceForm::SpaceText(text.into())),
    };
    let of = |space: Space| CreateIndexRequest {
        name: "other".into(),
        space_form: Some(SpaceForm::Space(space)),
    };
    let line = || Some(space(Kind::RealVector(RealVector { dimensions: 1 })));
    let deep = product(
        Composition::L2,
        vec![(Some(product(Composition::Sum, vec![(line(), None)])), None)],
    );
    let cases: Vec<(&str, CreateIndexRequest, (Code, &str))> = vec![
        ("no name", named("", "R2"), (InvalidArgument, "name")),
        ("a capital", named("Arm", "R2"), (InvalidArgument, "name")),
        ("a path", named("a/b", "R2"), (InvalidArgument, "name")),
        (
            "a long name",
            named(&"a".repeat(64), "R2"),
            (InvalidArgument, "name"),
        ),
        (
            "no space",
            CreateIndexRequest {
                name: "other".into(),
                space_form: None,
            },
            (InvalidArgument, "space"),
        ),
        (
            "an empty text",
            named("other", ""),
            (InvalidArgument, "space_text"),
        ),
        (
            "not a space",
            named("other", "R3*"),
            (InvalidArgument, "space_text"),
        ),
        (
            "a negative weight",
            named("other", "R3:-1"),
            (InvalidArgument, "space_text"),
        ),
        (
            "too wide",
            named("other", "R257"),
            (InvalidArgument, "space_text"),
        ),
        (
            "an empty space",
            of(Space { kind: None }),
            (InvalidArgument, "space"),
        ),
        (
            "no dimension",
            of(space(Kind::RealVector(RealVector { dimensions: 0 }))),
            (InvalidArgument, "space"),
        ),
        (
            "a period of nothing",
            of(space(Kind::So2(So2 { period: Some(0.0) }))),
            (InvalidArgument, "space"),
        ),
        (
            "an unspecified composition",
            of(product(Composition::Unspecified, vec![(line(), None)])),
            (InvalidArgument, "space"),
        ),
        (
            "an empty product",
            of(product(Composition::L2, vec![])),
            (InvalidArgument, "space"),
        ),
        (
            "a term of nothing",
            of(product(Composition::L2, vec![(None, None)])),
            (InvalidArgument, "space"),
        ),
        (
            "a weight that is not a number",
            of(product(Composition::L2, vec![(line(), Some(f64::NAN))])),
            (InvalidArgument, "space"),
        ),
        (
            "no weight above 0",
            of(product(Composition::L2, vec![(line(), Some(0.0))])),
            (InvalidArgument, "space"),
        ),
        (
            "a sum inside of a product",
            of(deep),
            (InvalidArgument, "space"),
        ),
        ("another space", named(INDEX, "R2"), (AlreadyExists, "")),
    ];
    for (what, request, (code, field)) in cases {
        let status = stub.create_index(request).await.expect_err(what);
        let refusal = wayfold_tests::Refusal::of(&status);
        assert_eq!(refusal.code, code, "{what}: {}", refusal.message);
        let named = refusal.fields.iter().map(|(name, _)| name.as_str());
        let named: Vec<&str> = named.collect();
        assert!(
            named.iter().all(|name| name.starts_with(field))
                && named.is_empty() == field.is_empty(),
            "{what}: {named:?}"
        );
        assert!(!refusal.reason.is_empty(), "{what}");
    }
    let listed = stub
        .list_indexes(ListIndexesRequest::default())
        .await
        .unwrap();
    let listed = listed.into_inner().indexes;
    assert_eq!(listed.len(), 1, "{listed:?}");

    // An equal space in other words is the same index.
    let again = stub
        .create_index(named(INDEX, "mpnn-se3"))
        .await
        .unwrap()
        .into_inner();
    assert!(!again.created);
    assert_eq!(
        again.index.unwrap().revision.unwrap().uid,
        bench.content.uid
    );
}

#[tokio::test]
async fn unknown_indices_and_pages_are_refused() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.indexes.clone();
    let index = "nowhere".to_owned();
    let unknown = (NotFound, "INDEX_NOT_FOUND", "");
    let request = GetIndexRequest {
        index: index.clone(),
    };
    let answer = stub.get_index(request).await;
    bench.refused("an unknown index", answer, unknown).await;
    let uid = String::new();
    let answer = stub.delete_index(DeleteIndexRequest { index, uid }).await;
    bench.refused("an unknown index", answer, unknown).await;

    let request = DeleteIndexRequest {
        index: INDEX.into(),
        uid: "another".into(),
    };
    let answer = stub.delete_index(request).await;
    let expected = (FailedPrecondition, "UID_MISMATCH", "");
    bench.refused("another uid", answer, expected).await;

    let request = ListIndexesRequest {
        page_token: "not a token".into(),
        ..Default::default()
    };
    let status = stub.list_indexes(request).await.unwrap_err();
    let refusal = wayfold_tests::Refusal::of(&status);
    assert_eq!(refusal.code, InvalidArgument);
    assert_eq!(refusal.fields[0].0, "page_token");
}
