//! The requests and answers of this face, by name, and where a request says which index it is for.

use prost::Message;
use wayfold_proto::v1;

/// A message with its name in `wayfold.v1`.
pub(super) trait Named: Message + Default {
    /// Its name.
    const NAME: &'static str;
}

/// A request that the key addresses.
pub(super) trait Request: Named {
    /// Where it names the index.
    fn index_mut(&mut self) -> &mut String;

    /// How many rows or ids it carries.
    fn rows(&self) -> usize {
        0
    }
}

/// A request for neighbours.
pub(super) trait SearchRequest: Request {
    /// What is to be told of each neighbour.
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
    ($($message:ident: $index:ident $(, $this:ident => $rows:expr)?;)*) => {
        named!($($message),*);
        $(impl Request for v1::$message {
            fn index_mut(&mut self) -> &mut String {
                &mut self.$index
            }

            $(fn rows(&self) -> usize {
                let $this = self;
                $rows
            })?
        })*
    };
}

requests! {
    KnnRequest: index, this => rows(this.states.as_ref());
    QueryRequest: index, this => rows(this.states.as_ref());
    InsertRequest: index, this => rows(this.states.as_ref());
    UpdateRequest: index, this => this.ids.len();
    RemoveRequest: index, this => this.ids.len();
    GetRequest: index, this => this.ids.len();
    WatchRequest: index;
    GetIndexRequest: name;
}

named!(
    CreateIndexRequest,
    ListIndexesRequest,
    DeleteIndexRequest,
    KnnResponse,
    QueryResponse,
    InsertResponse,
    UpdateResponse,
    RemoveResponse,
    GetResponse,
    WatchResponse,
    GetIndexResponse,
    CreateIndexResponse,
    ListIndexesResponse,
    DeleteIndexResponse,
    Status,
);

fn rows(states: Option<&v1::States>) -> usize {
    states.map_or(0, |states| states.rows as usize)
}
