//! `POST /api/v1/INDEX/points`: all points at one revision, and then each mutation, as frames of columns.
//!
//! A frame is two lengths (u32), a head (JSON) and a body, all little-endian; head and body are padded to multiples of
//! eight bytes. docs/http.md describes the heads. Numbers of a body are columns: `ids`, `revisions` and `tags` (u64), then
//! the coordinates row by row (f32: for pictures, not for answers).

use std::{sync::Arc, time::Duration};

use axum::{
    extract::{Path, RawQuery, State},
    http::request::Parts,
    response::Response,
};
use serde_json::json;
use tokio::time::timeout;
use wayfold_proto::v1;

use super::{
    api::{Admitted, Api, refusal},
    frame::{Frames, Share, json_of},
    streams::{self, FrameSource, MAX_SILENCE, StreamCall},
};
use crate::{
    observe::Ending,
    service::{Error, Scan, Watch},
    status::{self, Status},
    verbs::invalid,
};

/// The default of `max`.
const DEFAULT_MAX: u64 = 1_000_000;

/// The pause after a message of a watch: a picture needs no more, and each costs the server a little.
const PAUSE: Duration = Duration::from_millis(100);

/// Frames of a message of this size are followed by more.
const FULL_BYTES: usize = 128 * 1024;

/// The parameters of a request.
#[derive(Clone, Debug, PartialEq)]
struct PointsRequest {
    index: String,
    /// The most points to send first. An index with more sends an even sample.
    max: u64,
    /// True to send the mutations too.
    follow: bool,
    /// True to send the edges too, if the index declares how its payloads hold them.
    edges: bool,
    /// The revision that the caller has, to send only what came after it.
    after: Option<v1::Revision>,
    /// The part of the points that the caller has.
    share: Share,
}

impl PointsRequest {
    fn read(index: String, query: &str) -> Result<Self, Error> {
        let mut request = Self {
            index,
            max: DEFAULT_MAX,
            follow: false,
            edges: false,
            after: None,
            share: Share::ALL,
        };
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let malformed = |expected: &str| {
                invalid(
                    name,
                    "MALFORMED_PARAMETER",
                    format!("{value:?} is {expected}"),
                )
            };
            match name {
                "max" => {
                    request.max = value
                        .parse()
                        .ok()
                        .filter(|max| *max > 0)
                        .ok_or_else(|| malformed("no number of points from 1"))?;
                }
                "follow" | "edges" => {
                    let value = value
                        .parse()
                        .map_err(|_| malformed("neither true nor false"))?;
                    match name {
                        "follow" => request.follow = value,
                        _ => request.edges = value,
                    }
                }
                "after" => {
                    let (uid, number) = value
                        .split_once(':')
                        .ok_or_else(|| malformed("no revision, UID:NUMBER"))?;
                    request.after = Some(v1::Revision {
                        uid: uid.into(),
                        number: number
                            .parse()
                            .map_err(|_| malformed("no revision, UID:NUMBER"))?,
                    });
                }
                "share" => {
                    let share = value.parse().ok().and_then(Share::from_fraction);
                    request.share = share.ok_or_else(|| malformed("no number from 0 to 1"))?;
                }
                _ => {
                    let text = "there are max, follow, edges, after and share";
                    return Err(invalid(name, "UNKNOWN_PARAMETER", text));
                }
            }
        }
        Ok(request)
    }
}

/// Answers with the stream of an index.
pub(super) async fn points(
    State(api): State<Arc<Api>>,
    Path(index): Path<String>,
    RawQuery(query): RawQuery,
    request: Parts,
) -> Response {
    let mut call = match StreamCall::admit(&api, "points", &request) {
        Ok(call) => call,
        Err(status) => return refusal(&status),
    };
    match PointsRequest::read(index, query.as_deref().unwrap_or_default()) {
        Ok(request) => streams::answer(call, PointStream::new(request)).await,
        Err(error) => {
            let status = status::from_error(&error);
            call.end(Ending::Failed(status.code));
            refusal(&status)
        }
    }
}

/// A running stream.
struct PointStream {
    request: PointsRequest,
    source: Source,
    share: Share,
    /// The bytes of an edge in a payload; None if edges are not sent.
    edge_bytes: Option<usize>,
    /// The last revision that was sent whole.
    reached: v1::Revision,
}

/// Where the next frames come from.
enum Source {
    /// Nothing was sent.
    All,
    /// Nothing was sent, and the caller has all points at this revision.
    After(v1::Revision),
    Scan(Box<Scan>, Option<v1::Revision>),
    Watch(Box<Watch>),
    End,
}

impl FrameSource for PointStream {
    async fn next(&mut self, call: &mut StreamCall) -> Result<Option<Frames>, Status> {
        loop {
            let source = std::mem::replace(&mut self.source, Source::End);
            let (source, frames) = match source {
                Source::End => return Ok(None),
                Source::All => {
                    self.describe(call).await?;
                    (self.scan(call).await?, Frames::default())
                }
                Source::After(after) => {
                    self.describe(call).await?;
                    self.reached = after.clone();
                    (self.watch(call, after).await?, Frames::default())
                }
                Source::Scan(scan, revision) => self.scanned(call, scan, revision).await?,
                Source::Watch(watch) => self.watched(call, watch).await?,
            };
            self.source = source;
            if !frames.is_empty() {
                return Ok(Some(frames));
            }
        }
    }
}

impl PointStream {
    fn new(request: PointsRequest) -> Self {
        Self {
            source: match request.after.clone() {
                Some(after) => Source::After(after),
                None => Source::All,
            },
            share: request.share,
            request,
            edge_bytes: None,
            reached: v1::Revision::default(),
        }
    }

    /// Learns how the payloads hold edges.
    async fn describe(&mut self, call: &mut StreamCall) -> Result<(), Status> {
        if !self.request.edges {
            return Ok(());
        }
        let request = v1::GetIndexRequest {
            index_name: self.request.index.clone(),
        };
        let service = call.api.shared.service.clone();
        let Admitted { call, turns, .. } = &mut call.admitted;
        let described = streams::in_turn(turns, service.get_index(call, request)).await?;
        let index = described.index.unwrap_or_default();
        self.edge_bytes = match index.payload_encoding() {
            v1::PayloadEncoding::Unspecified => None,
            v1::PayloadEncoding::Edges => Some(8),
            v1::PayloadEncoding::WeightedEdges => Some(16),
        };
        Ok(())
    }

    /// The columns that are read.
    fn include(&self) -> v1::Include {
        v1::Include {
            with_states: true,
            with_tags: true,
            with_revisions: true,
            with_payloads: self.edge_bytes.is_some(),
        }
    }

    async fn scan(&mut self, call: &mut StreamCall) -> Result<Source, Status> {
        let request = v1::ScanRequest {
            index_name: self.request.index.clone(),
            include: Some(self.include()),
            ..Default::default()
        };
        let service = call.api.shared.service.clone();
        let Admitted { call, turns, .. } = &mut call.admitted;
        let scan = streams::in_turn(turns, service.scan(call, request)).await?;
        Ok(Source::Scan(Box::new(scan), None))
    }

    async fn watch(
        &mut self,
        call: &mut StreamCall,
        after: v1::Revision,
    ) -> Result<Source, Status> {
        let request = v1::WatchRequest {
            index_name: self.request.index.clone(),
            after_revision: Some(after),
            include: Some(self.include()),
            ..Default::default()
        };
        let service = call.api.shared.service.clone();
        let Admitted { call, turns, .. } = &mut call.admitted;
        let watch = streams::in_turn(turns, service.watch(call, request)).await?;
        Ok(Source::Watch(Box::new(watch.uncounted())))
    }

    /// The next part of a scan. `revision` is the one that it reads, once it is known.
    async fn scanned(
        &mut self,
        call: &mut StreamCall,
        mut scan: Box<Scan>,
        revision: Option<v1::Revision>,
    ) -> Result<(Source, Frames), Status> {
        let mut frames = Frames::default();
        let next = async { scan.next().await.transpose() };
        let Some(part) = streams::in_turn(&mut call.admitted.turns, next).await? else {
            self.reached = revision.unwrap_or_default();
            frames.push_at(&self.reached);
            let source = match self.request.follow {
                true => self.watch(call, self.reached.clone()).await?,
                false => Source::End,
            };
            return Ok((source, frames));
        };
        let points = part.points.unwrap_or_default();
        let read = match revision {
            Some(revision) => revision,
            None => {
                self.share = Share::of(self.request.max, part.point_count);
                let read = part.revision.unwrap_or_default();
                let oldest = v1::Revision {
                    number: scan.window_start(),
                    ..read.clone()
                };
                let head = json!({
                    "kind": "begin", "revision": json_of(&read), "oldest_revision": json_of(&oldest),
                    "coordinate_count": scan.coordinates(), "point_count": part.point_count,
                    "share": self.share.fraction(),
                });
                frames.push(&head, &[]);
                read
            }
        };
        frames.push_points(&points, self.share);
        if let Some(edge_bytes) = self.edge_bytes {
            frames.push_edges(&points, self.share, edge_bytes);
        }
        Ok((Source::Scan(scan, Some(read)), frames))
    }

    /// The next mutations.
    async fn watched(
        &mut self,
        call: &mut StreamCall,
        mut watch: Box<Watch>,
    ) -> Result<(Source, Frames), Status> {
        let mut frames = Frames::default();
        let next = async {
            // A wait that is cut loses no message.
            match timeout(MAX_SILENCE, watch.next()).await {
                Ok(message) => message.transpose().map(Some),
                Err(_) => Ok(None),
            }
        };
        let message = match streams::in_turn(&mut call.admitted.turns, next).await? {
            Some(Some(message)) => message,
            Some(None) => return Ok((Source::End, frames)),
            None => {
                frames.push_at(&self.reached);
                return Ok((Source::Watch(watch), frames));
            }
        };
        if message.reset.is_some() {
            let reason = message.reset().as_str_name();
            let reason = reason.trim_start_matches("RESET_REASON_");
            frames.push(&json!({ "kind": "reset", "reason": reason }), &[]);
            return Ok((Source::All, frames));
        }
        let mut replaced = watch.replaced().iter().peekable();
        for mutation in &message.mutations {
            let revision = mutation.revision.clone().unwrap_or_default();
            let ids: Vec<u64> =
                std::iter::from_fn(|| replaced.next_if(|(at, _)| *at == revision.number))
                    .map(|(_, id)| *id)
                    .collect();
            frames.push_replaced(&ids, &revision, self.share);
            if let Some(stored) = &mutation.stored {
                frames.push_points(stored, self.share);
                if let Some(edge_bytes) = self.edge_bytes {
                    frames.push_edges(stored, self.share, edge_bytes);
                }
            }
            frames.push_removed(&mutation.removed_ids, &revision, self.share);
            if !mutation.continued {
                self.reached = revision;
            }
        }
        frames.push_at(&self.reached);
        // A reader that is far behind gets the next ones at once.
        if !message.mutations.is_empty() && frames.len() < FULL_BYTES {
            let _ = timeout(PAUSE, std::future::pending::<()>()).await;
        }
        Ok((Source::Watch(watch), frames))
    }
}
