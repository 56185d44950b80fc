//! Every kind of bad input gets its code, its reason and the field it is about, and leaves the index as it was.

mod index_calls;
mod limits;
mod malformed;
mod mutations;
mod reads;
mod states;

use tonic::{Code, Status};
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Refusal, ServerProcess, Stubs, row_states, server};

const INDEX: &str = "roadmap";

/// A server with one index of SE(3) that holds the points 1, 2 and 3.
struct Bench {
    _server: ServerProcess,
    stubs: Stubs,
    content: Content,
}

impl Bench {
    async fn new() -> Self {
        Self::on(server!()).await
    }

    async fn on(server: ServerProcess) -> Self {
        let mut stubs = Stubs::connect(server.uri()).await;
        stubs.create(INDEX, "R3*SO3:0.15").await;
        let rows = [good_row(), good_row(), good_row()].concat();
        let request = InsertRequest {
            index: INDEX.into(),
            states: Some(row_states(&rows, 7)),
            ids: vec![1, 2, 3],
            ..Default::default()
        };
        stubs.insert(request).await;
        let content = Content::read(&stubs, INDEX).await.unwrap();
        Self {
            _server: server,
            stubs,
            content,
        }
    }

    /// Checks what a refusal says and that nothing changed. An empty field: the refusal is about none.
    async fn refused<T: std::fmt::Debug>(
        &self,
        what: &str,
        answer: Result<T, Status>,
        (code, reason, field): (Code, &str, &str),
    ) -> Refusal {
        let status = answer.expect_err(what);
        let refusal = Refusal::of(&status);
        let fields: Vec<&str> = refusal.fields.iter().map(|(name, _)| &**name).collect();
        let expected = if field.is_empty() {
            vec![]
        } else {
            vec![field]
        };
        assert_eq!(
            (refusal.code, &*refusal.reason, fields),
            (code, reason, expected),
            "{what}: {}",
            refusal.message
        );
        assert!(
            refusal.message.contains(field),
            "{what}: {}",
            refusal.message
        );
        assert!(!refusal.message.is_empty(), "{what}");
        let content = Content::read(&self.stubs, INDEX).await.unwrap();
        assert_eq!(content, self.content, "{what} changed the index");
        refusal
    }
}

fn good_row() -> Vec<f64> {
    vec![1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
}
