//! The names of all calls: their verbs in metrics, and which of them are streams.

/// The calls of our own services.
const OURS: &str = "/wayfold.v1.";

/// The calls whose requests are streams.
const REQUEST_STREAMS: [&str; 2] = ["PointService/StreamKnn", "IndexService/RestoreIndex"];

/// The calls whose answers are streams.
const ANSWER_STREAMS: [&str; 5] = [
    "PointService/StreamKnn",
    "PointService/Scan",
    "PointService/Watch",
    "IndexService/SnapshotIndex",
    "IndexService/VerifyIndex",
];

/// The streams that last for as long as their clients like.
const LASTING: [&str; 2] = ["PointService/StreamKnn", "PointService/Watch"];

/// All calls, and their verbs in metrics.
const VERBS: [(&str, &str); 19] = [
    ("IndexService/GetServer", "server"),
    ("IndexService/CreateIndex", "create"),
    ("IndexService/GetIndex", "info"),
    ("IndexService/ListIndexes", "list"),
    ("IndexService/DeleteIndex", "delete"),
    ("IndexService/SnapshotIndex", "snapshot"),
    ("IndexService/RestoreIndex", "restore"),
    ("IndexService/VerifyIndex", "verify"),
    ("PointService/Insert", "insert"),
    ("PointService/Update", "update"),
    ("PointService/Remove", "remove"),
    ("PointService/OpenSession", "session"),
    ("PointService/Write", "write"),
    ("PointService/Get", "get"),
    ("PointService/Knn", "knn"),
    ("PointService/Query", "query"),
    ("PointService/StreamKnn", "stream_knn"),
    ("PointService/Scan", "scan"),
    ("PointService/Watch", "watch"),
];

/// True if the requests of a call are a stream.
pub(super) fn has_stream_of_requests(rpc: &str) -> bool {
    REQUEST_STREAMS.contains(&rpc)
}

/// True if the answers of a call are a stream.
pub(super) fn has_stream_of_answers(rpc: &str) -> bool {
    ANSWER_STREAMS.contains(&rpc)
}

/// True if a call is one of `IndexService`.
pub(super) fn is_of_indices(rpc: &str) -> bool {
    rpc.starts_with("IndexService/")
}

/// True if a call is a stream that lasts for as long as its client likes.
pub(super) fn is_lasting(rpc: &str) -> bool {
    LASTING.contains(&rpc)
}

/// The verb of a call in metrics. A call that does not exist has none of its own: its name may be anything.
pub(super) fn verb(rpc: &str) -> &'static str {
    let known = VERBS.iter().find(|(known, _)| *known == rpc);
    known.map_or("other", |(_, verb)| verb)
}

/// `PointService/Knn` of `/wayfold.v1.PointService/Knn`; None for paths of other packages.
pub(super) fn our_rpc(path: &str) -> Option<&str> {
    path.strip_prefix(OURS)
}
