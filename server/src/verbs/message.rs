//! The requests and answers, by name, and the index field of requests.

use prost::Message;
use wayfold_proto::v1;

use crate::observe;

/// A message with its name in `wayfold.v1`.
pub(crate) trait Named: Message + Default {
    /// Its name.
    const NAME: &'static str;
}

/// A request to the index in the key.
pub(crate) trait IndexRequest: Named + observe::Request {
    /// Its field for the index.
    fn index_mut(&mut self) -> &mut String;
}

/// A request for neighbours.
pub(crate) trait SearchRequest: IndexRequest {
    /// The columns requested of each neighbour.
    fn include(&self) -> Option<v1::Include>;
}

impl SearchRequest for v1::KnnRequest {
    fn include(&self) -> Option<v1::Include> {
        self.include
    }
}

impl SearchRequest for v1::QueryRequest {
    fn include(&self) -> Option<v1::Include> {
        self.include
    }
}

macro_rules! named {
    ($($message:ident),* $(,)?) => {
        $(impl Named for v1::$message {
            const NAME: &'static str = stringify!($message);
        })*
    };
}

macro_rules! requests {
    ($($message:ident),* $(,)?) => {
        named!($($message),*);
        $(impl IndexRequest for v1::$message {
            fn index_mut(&mut self) -> &mut String {
                &mut self.index_name
            }
        })*
    };
}

requests!(
    KnnRequest,
    QueryRequest,
    InsertRequest,
    UpdateRequest,
    RemoveRequest,
    OpenSessionRequest,
    WriteRequest,
    GetRequest,
    ScanRequest,
    WatchRequest,
    GetIndexRequest,
);

named!(
    GetServerRequest,
    CreateIndexRequest,
    ListIndexesRequest,
    DeleteIndexRequest,
    KnnResponse,
    QueryResponse,
    InsertResponse,
    UpdateResponse,
    RemoveResponse,
    OpenSessionResponse,
    WriteResponse,
    GetResponse,
    ScanResponse,
    WatchResponse,
    GetIndexResponse,
    CreateIndexResponse,
    ListIndexesResponse,
    DeleteIndexResponse,
    GetServerResponse,
    Status,
);
