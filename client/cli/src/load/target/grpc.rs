//! Calls over gRPC: a connection of its own, driven by the thread that calls.

use std::time::Duration;

use tokio::{runtime::Runtime, time};
use wayfold::{
    Client, Error, Filter, Include, IndexHandle, Neighbor, RetryPolicy, ServerInfo, Space,
};

use super::{Address, Request, ServerFacts, Target, own_runtime};
use crate::failure::Failure;

pub(crate) struct GrpcTarget {
    runtime: Runtime,
    client: Client,
    /// Its calls are made once: a retry would hide a refusal.
    index: IndexHandle,
    /// For what is no part of the measurement.
    patient: IndexHandle,
    /// The time for the answers of a stream, which has none of its own.
    timeout: Duration,
}

impl GrpcTarget {
    pub(super) fn open(address: &Address, index: &str, timeout: Duration) -> Result<Self, Failure> {
        let runtime = own_runtime()?;
        let server = &*address.server;
        let builder = Client::builder()
            .timeout(timeout)
            .credentials(address.credentials.clone());
        let patient = builder.clone().retry(RetryPolicy::until_deadline());
        let (client, patient, once) = runtime.block_on(async {
            let client = patient.connect(server).await?;
            let patient = client.index(index).await?;
            let once = builder.retry(RetryPolicy::never()).connect(server).await?;
            let once = once.index(index).await?;
            // The client learns the server's limits with its first call of several states.
            let width = once.coordinates();
            let rows = [vec![0.0; width], vec![0.0; width]];
            let _ = once.knn(rows).k(1).await;
            Ok::<_, Error>((client, patient, once))
        })?;
        Ok(GrpcTarget {
            runtime,
            client,
            index: once,
            patient,
            timeout,
        })
    }

    /// Up to `most` ids of the points that a filter lets through.
    fn ids_of(&self, filter: &Filter, most: usize) -> Result<Vec<u64>, Error> {
        self.runtime.block_on(async {
            let request = self.patient.scan().filter(filter.clone());
            let mut scan = request.include(Include::none()).await?;
            let mut ids = Vec::new();
            while let Some(points) = scan.next().await? {
                ids.extend_from_slice(points.ids());
                if ids.len() >= most {
                    ids.truncate(most);
                    break;
                }
            }
            Ok(ids)
        })
    }

    /// Asks for each state by itself, with many requests under way.
    async fn stream(&self, rows: &[f64], k: u32) -> Result<(), Error> {
        let (mut requests, mut answers) = self.index.stream_knn().await?;
        let send = async move {
            for row in rows.chunks_exact(self.index.coordinates()) {
                requests.send(self.index.knn([row]).k(k)).await?;
            }
            Ok(())
        };
        let receive = async {
            while answers.next().await?.is_some() {}
            Ok(())
        };
        tokio::try_join!(send, receive).map(drop)
    }
}

impl Target for GrpcTarget {
    fn runtime(&self) -> &Runtime {
        &self.runtime
    }

    fn space(&self) -> Space {
        self.index.space().clone()
    }

    fn server(&self) -> Result<Option<ServerFacts>, Error> {
        let ServerInfo {
            version,
            durability,
            ..
        } = self.runtime.block_on(self.client.server())?;
        Ok(Some(ServerFacts {
            version,
            durability,
        }))
    }

    fn point_count(&self) -> Result<u64, Error> {
        let info = self.runtime.block_on(self.patient.info())?;
        Ok(info.point_count)
    }

    fn call(&mut self, request: &Request<'_>) -> Result<(), Error> {
        let (index, width) = (&self.index, self.index.coordinates());
        match *request {
            Request::Insert { rows, tag } => {
                let tags = vec![tag; rows.len() / width];
                let insert = index.insert(rows.chunks_exact(width)).tags(tags);
                self.runtime.block_on(insert.into_future()).map(drop)
            }
            Request::Knn { rows, k } => {
                let knn = index.knn(rows.chunks_exact(width)).k(k);
                self.runtime.block_on(knn.into_future()).map(drop)
            }
            Request::Query { rows, radius } => {
                let query = index.query(rows.chunks_exact(width), radius);
                self.runtime.block_on(query.into_future()).map(drop)
            }
            Request::Stream { rows, k } => self.runtime.block_on(async {
                let answered = time::timeout(self.timeout, self.stream(rows, k)).await;
                answered.unwrap_or(Err(Error::Timeout {
                    call: "stream_knn",
                    timeout: self.timeout,
                    earlier: None,
                }))
            }),
            Request::Get { ids } => {
                let get = index.get(ids).into_future();
                self.runtime.block_on(get).map(drop)
            }
        }
    }

    fn store(&mut self, rows: &[f64], tag: u64) -> Result<(), Error> {
        let rows = rows.chunks_exact(self.index.coordinates());
        let tags = vec![tag; rows.len()];
        let insert = self.patient.insert(rows).tags(tags).into_future();
        self.runtime.block_on(insert).map(drop)
    }

    fn neighbors(&self, rows: &[f64], k: u32) -> Result<Vec<Vec<Neighbor>>, Error> {
        let rows = rows.chunks_exact(self.index.coordinates());
        let knn = self.patient.knn(rows).k(k).into_future();
        let found = self.runtime.block_on(knn)?;
        Ok(found.rows().map(|row| row.iter().collect()).collect())
    }

    fn ids(&self, most: usize) -> Result<Vec<u64>, Error> {
        self.ids_of(&Filter::default(), most)
    }

    fn remove_tagged(&self, tag: u64) -> Result<u64, Error> {
        // The removals of one scan, so that a long list of ids does not fill the memory.
        const IDS: usize = 1_000_000;
        let filter = Filter::default().tag(u64::MAX, tag);
        let mut removed = 0;
        loop {
            // The reads of this handle see what the other handles of the run wrote.
            self.runtime.block_on(self.patient.info())?;
            let ids = self.ids_of(&filter, IDS)?;
            if ids.is_empty() {
                return Ok(removed);
            }
            let remove = self.patient.remove(ids).into_future();
            removed += self.runtime.block_on(remove)?.removed_count;
        }
    }

    fn settle(&mut self) -> u64 {
        0
    }
}
