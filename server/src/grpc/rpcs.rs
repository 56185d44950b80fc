//! The calls of our services by name: their verbs in metrics, and which of them are streams.

/// The calls of our own services.
const OURS: &str = "/wayfold.v1.";

/// A call of our services.
#[derive(Clone, Copy)]
pub(super) struct Rpc {
    /// Its service and method, such as `PointService/Knn`.
    pub(super) path: &'static str,
    /// Its verb in metrics.
    pub(super) verb: &'static str,
    pub(super) streams_requests: bool,
    pub(super) streams_answers: bool,
    /// True if it is a stream that lasts for as long as its client likes.
    pub(super) lasts: bool,
}

const RPCS: [Rpc; 19] = [
    Rpc::unary("PointService/Insert", "insert"),
    Rpc::unary("PointService/Update", "update"),
    Rpc::unary("PointService/Remove", "remove"),
    Rpc::unary("PointService/OpenSession", "session"),
    Rpc::unary("PointService/Write", "write"),
    Rpc::unary("PointService/Get", "get"),
    Rpc::unary("PointService/Knn", "knn"),
    Rpc::unary("PointService/Query", "query"),
    Rpc {
        streams_requests: true,
        lasts: true,
        ..Rpc::answering_in_parts("PointService/StreamKnn", "stream_knn")
    },
    Rpc::answering_in_parts("PointService/Scan", "scan"),
    Rpc {
        lasts: true,
        ..Rpc::answering_in_parts("PointService/Watch", "watch")
    },
    Rpc::unary("IndexService/GetServer", "server"),
    Rpc::unary("IndexService/CreateIndex", "create"),
    Rpc::unary("IndexService/GetIndex", "info"),
    Rpc::unary("IndexService/ListIndexes", "list"),
    Rpc::unary("IndexService/DeleteIndex", "delete"),
    Rpc::answering_in_parts("IndexService/SnapshotIndex", "snapshot"),
    Rpc {
        streams_requests: true,
        ..Rpc::unary("IndexService/RestoreIndex", "restore")
    },
    Rpc::answering_in_parts("IndexService/VerifyIndex", "verify"),
];

impl Rpc {
    const fn unary(path: &'static str, verb: &'static str) -> Self {
        Self {
            path,
            verb,
            streams_requests: false,
            streams_answers: false,
            lasts: false,
        }
    }

    const fn answering_in_parts(path: &'static str, verb: &'static str) -> Self {
        Self {
            streams_answers: true,
            ..Self::unary(path, verb)
        }
    }

    /// The call of a path, such as `/wayfold.v1.PointService/Knn`; None for a path without a call.
    pub(super) fn of(path: &str) -> Option<Self> {
        let path = path.strip_prefix(OURS)?;
        RPCS.iter().find(|known| known.path == path).copied()
    }

    /// True if it has one request and one answer.
    pub(super) fn is_unary(self) -> bool {
        !self.streams_requests && !self.streams_answers
    }

    /// True for a `Watch`, which lasts and has one request.
    pub(super) fn is_watch(self) -> bool {
        self.lasts && !self.streams_requests
    }

    /// True if it reads points and has one answer, which may be large.
    pub(super) fn is_read(self) -> bool {
        matches!(self.verb, "get" | "knn" | "query")
    }

    /// True if it is a call of `IndexService`.
    pub(super) fn is_of_indices(self) -> bool {
        self.path.starts_with("IndexService/")
    }
}
