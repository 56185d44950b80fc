//! The calls for points.

use tonic::{Request, Response, Status, Streaming, async_trait};
use wayfold_proto::v1::{self, point_service_server::PointService};

use super::{Answers, Fake, LIMITS, answers, exceeded, revision};

fn rows(states: &Option<v1::States>) -> usize {
    states
        .as_ref()
        .map_or(0, |states| states.row_count as usize)
}

/// Its own number as the one neighbour of each state.
fn numbered(rows: usize) -> Option<v1::Neighbors> {
    Some(v1::Neighbors {
        neighbor_counts: vec![1; rows],
        ids: (0..rows as u64).collect(),
        distances: vec![0.5; rows],
        ..Default::default()
    })
}

impl Fake {
    /// Reserves at most this many ids at once, as a server that was started again may.
    pub(crate) fn limit_reserved_ids(&self, most: u64) {
        self.inner.lock().unwrap().limits = Some(v1::Limits {
            max_reserved_ids: most,
            ..LIMITS
        });
    }

    /// The refusal of a call that reserves too many ids.
    fn too_many_ids(&self, reserve_count: u64) -> Option<Status> {
        let limits = self.inner.lock().unwrap().limits.unwrap_or(LIMITS);
        let most = limits.max_reserved_ids;
        (reserve_count > most).then(|| exceeded("max_reserved_ids", most))
    }
}

#[async_trait]
impl PointService for Fake {
    async fn insert(
        &self,
        request: Request<v1::InsertRequest>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let rows = rows(&request.get_ref().states);
        let received = request.get_ref().clone();
        self.inner.lock().unwrap().insert.push(received);
        let number = self.enter(&request, rows).await?;
        Ok(Response::new(v1::InsertResponse {
            outcomes: vec![v1::Outcome::Inserted.into(); rows],
            ids: (0..rows as u64).collect(),
            neighbors: request
                .into_inner()
                .neighbor_spec
                .and_then(|_| numbered(rows)),
            revision: revision(number),
        }))
    }

    async fn update(
        &self,
        request: Request<v1::UpdateRequest>,
    ) -> Result<Response<v1::UpdateResponse>, Status> {
        let number = self.enter(&request, request.get_ref().ids.len()).await?;
        Ok(Response::new(v1::UpdateResponse {
            updated_count: request.into_inner().ids.len() as u64,
            revision: revision(number),
            ..Default::default()
        }))
    }

    async fn open_session(
        &self,
        request: Request<v1::OpenSessionRequest>,
    ) -> Result<Response<v1::OpenSessionResponse>, Status> {
        if let Some(refused) = self.too_many_ids(request.get_ref().reserve_count) {
            return Err(refused);
        }
        let mut inner = self.inner.lock().unwrap();
        inner.sessions += 1;
        Ok(Response::new(v1::OpenSessionResponse {
            session: inner.sessions,
            reserved: Some(v1::IdBlock {
                first_id: 1 << 32,
                id_count: request.into_inner().reserve_count,
            }),
            idle_seconds: 60,
            revision: revision(1),
        }))
    }

    async fn write(
        &self,
        request: Request<v1::WriteRequest>,
    ) -> Result<Response<v1::WriteResponse>, Status> {
        self.enter(&request, request.get_ref().ids.len()).await?;
        if let Some(refused) = self.too_many_ids(request.get_ref().reserve_count) {
            return Err(refused);
        }
        let taken = self.inner.lock().unwrap().takes_at;
        let taken = taken.ok_or_else(|| Status::unimplemented("write"))?;
        Ok(Response::new(v1::WriteResponse {
            revision: revision(taken),
            ..Default::default()
        }))
    }

    async fn remove(
        &self,
        request: Request<v1::RemoveRequest>,
    ) -> Result<Response<v1::RemoveResponse>, Status> {
        let received = request.get_ref().clone();
        self.inner.lock().unwrap().remove.push(received);
        let number = self.enter(&request, request.get_ref().ids.len()).await?;
        Ok(Response::new(v1::RemoveResponse {
            removed_count: request.into_inner().ids.len() as u64,
            revision: revision(number),
            ..Default::default()
        }))
    }

    async fn get(
        &self,
        request: Request<v1::GetRequest>,
    ) -> Result<Response<v1::GetResponse>, Status> {
        let number = self.enter(&request, request.get_ref().ids.len()).await?;
        let request = request.into_inner();
        let mut inner = self.inner.lock().unwrap();
        inner.get.push(request.clone());
        let stored = match (&inner.stored, request.ids.is_empty()) {
            (Some(stored), _) => stored,
            // It only waits for a revision.
            (None, true) => &Default::default(),
            (None, false) => return Err(Status::unimplemented("get")),
        };
        let missing: Vec<u64> = request
            .ids
            .iter()
            .copied()
            .filter(|id| !stored.contains(id))
            .collect();
        if !missing.is_empty() {
            return Err(super::not_found(&missing));
        }
        let payload = |id: &u64| id.to_string().into_bytes().into();
        Ok(Response::new(v1::GetResponse {
            points: Some(v1::Points {
                payloads: request.ids.iter().map(payload).collect(),
                ids: request.ids,
                ..Default::default()
            }),
            revision: revision(number),
        }))
    }

    async fn knn(
        &self,
        request: Request<v1::KnnRequest>,
    ) -> Result<Response<v1::KnnResponse>, Status> {
        let rows = rows(&request.get_ref().states);
        let received = request.get_ref().clone();
        self.inner.lock().unwrap().knn.push(received);
        let number = self.enter(&request, rows).await?;
        Ok(Response::new(v1::KnnResponse {
            neighbors: numbered(rows),
            revision: revision(number),
        }))
    }

    async fn query(
        &self,
        request: Request<v1::QueryRequest>,
    ) -> Result<Response<v1::QueryResponse>, Status> {
        let rows = rows(&request.get_ref().states);
        let number = self.enter(&request, rows).await?;
        Ok(Response::new(v1::QueryResponse {
            // Not as many counts as states: against the protocol.
            neighbors: numbered(rows + 1),
            revision: revision(number),
        }))
    }

    type StreamKnnStream = Answers<v1::StreamKnnResponse>;

    async fn stream_knn(
        &self,
        request: Request<Streaming<v1::StreamKnnRequest>>,
    ) -> Result<Response<Self::StreamKnnStream>, Status> {
        self.enter(&request, 0).await?;
        Ok(answers(std::iter::empty(), true))
    }

    type WatchStream = Answers<v1::WatchResponse>;

    async fn watch(
        &self,
        request: Request<v1::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        self.enter(&request, 0).await?;
        let mut inner = self.inner.lock().unwrap();
        inner.watched.push(request.into_inner());
        let messages = inner.watches.pop_front().unwrap_or_else(|| {
            vec![Ok(v1::WatchResponse {
                revision: revision(0),
                ..Default::default()
            })]
        });
        let ends = messages.last().is_some_and(Result::is_err);
        Ok(answers(messages.into_iter(), ends))
    }

    type ScanStream = Answers<v1::ScanResponse>;

    async fn scan(
        &self,
        request: Request<v1::ScanRequest>,
    ) -> Result<Response<Self::ScanStream>, Status> {
        self.enter(&request, 0).await?;
        let scan = self.inner.lock().unwrap().scans.pop_front();
        let (parts, end) = scan.unwrap_or((Vec::new(), true));
        Ok(answers(parts.into_iter().map(Ok), end))
    }
}
