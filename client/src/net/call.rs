//! The calls with one answer, over either transport.

use tonic::{Request, Response, Status};
use wayfold_proto::v1;

use super::connections::Connection;

/// The end of a call's key over Zenoh.
#[cfg(feature = "zenoh")]
pub(crate) enum Key {
    /// Under the prefix.
    Server(&'static str),
    /// Under the name of the index.
    Index(&'static str),
}

/// The request of a call.
pub(crate) trait Call: prost::Message + Clone {
    type Answer: prost::Message + Default;
    /// Its name in errors.
    const NAME: &'static str;
    #[cfg(feature = "zenoh")]
    const KEY: Key;

    /// Sends it over gRPC.
    fn send(
        connection: Connection,
        request: Request<Self>,
    ) -> impl Future<Output = Result<Response<Self::Answer>, Status>> + Send;
}

macro_rules! calls {
    ($($request:ident, $answer:ident, $stub:ident.$call:ident, $key:expr;)*) => {
        $(impl Call for v1::$request {
            type Answer = v1::$answer;
            const NAME: &'static str = stringify!($call);
            #[cfg(feature = "zenoh")]
            const KEY: Key = $key;

            async fn send(
                connection: Connection,
                request: Request<Self>,
            ) -> Result<Response<Self::Answer>, Status> {
                connection.$stub().$call(request).await
            }
        })*
    };
}

calls! {
    GetServerRequest, GetServerResponse, indexes.get_server, Key::Server("server");
    CreateIndexRequest, CreateIndexResponse, indexes.create_index, Key::Server("create");
    ListIndexesRequest, ListIndexesResponse, indexes.list_indexes, Key::Server("list");
    DeleteIndexRequest, DeleteIndexResponse, indexes.delete_index, Key::Server("delete");
    GetIndexRequest, GetIndexResponse, indexes.get_index, Key::Index("info");
    OpenSessionRequest, OpenSessionResponse, points.open_session, Key::Index("session");
    WriteRequest, WriteResponse, points.write, Key::Index("write");
    InsertRequest, InsertResponse, points.insert, Key::Index("insert");
    UpdateRequest, UpdateResponse, points.update, Key::Index("update");
    RemoveRequest, RemoveResponse, points.remove, Key::Index("remove");
    GetRequest, GetResponse, points.get, Key::Index("get");
    KnnRequest, KnnResponse, points.knn, Key::Index("knn");
    QueryRequest, QueryResponse, points.query, Key::Index("query");
}
