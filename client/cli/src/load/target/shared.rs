//! Calls on a shared index: a copy in this process, over gRPC or Zenoh.

use std::time::Duration;

use tokio::runtime::Runtime;
use wayfold::{Error, Index, InsertOptions, Neighbor, Search, Space};

use super::{Address, Request, ServerFacts, Target, own_runtime};
use crate::{failure::Failure, load::error::LoadError};

pub(crate) struct SharedTarget {
    /// For waiting: the index has a thread of its own.
    runtime: Runtime,
    index: Index,
    /// The writes that the server has refused for good.
    refused: u64,
    timeout: Duration,
}

impl SharedTarget {
    pub(super) fn open(
        address: &Address,
        index: &str,
        timeout: Duration,
    ) -> Result<SharedTarget, Failure> {
        let index = match &address.prefix {
            None => Index::shared(&address.server, index),
            Some(prefix) => over_zenoh(address, prefix, index, timeout)?,
        };
        Ok(SharedTarget {
            runtime: own_runtime()?,
            index: index
                .timeout(timeout)
                .credentials(address.credentials.clone())
                .open()?,
            refused: 0,
            timeout,
        })
    }

    fn make(&self, request: &Request<'_>) -> Result<(), Error> {
        let (index, width) = (&self.index, self.index.space().coordinates());
        match *request {
            Request::Insert { rows, tag } => {
                for row in rows.chunks_exact(width) {
                    index.insert_with(row, InsertOptions::new().tag(tag))?;
                }
            }
            // Nothing travels, so a stream has nothing to add.
            Request::Knn { rows, k } | Request::Stream { rows, k } => {
                index.search_many(rows.chunks_exact(width), &Search::k(k))?;
            }
            Request::Query { rows, radius } => {
                index.search_many(rows.chunks_exact(width), &Search::within(radius))?;
            }
            Request::Get { ids } => {
                for id in ids {
                    std::hint::black_box(index.get(*id)?);
                }
            }
        }
        Ok(())
    }
}

impl Target for SharedTarget {
    fn runtime(&self) -> &Runtime {
        &self.runtime
    }

    fn space(&self) -> Space {
        self.index.space().clone()
    }

    fn server(&self) -> Result<Option<ServerFacts>, Error> {
        Ok(None)
    }

    fn point_count(&self) -> Result<u64, Error> {
        Ok(self.index.len()? as u64)
    }

    fn call(&mut self, request: &Request<'_>) -> Result<(), Error> {
        let done = self.make(request);
        if let Err(Error::WritesRefused { .. }) = &done {
            // The index takes writes again after this.
            self.refused += self.index.take_unsent().len() as u64;
        }
        done
    }

    fn store(&mut self, rows: &[f64], tag: u64) -> Result<(), Error> {
        self.call(&Request::Insert { rows, tag })?;
        self.index.flush()
    }

    fn neighbors(&self, rows: &[f64], k: u32) -> Result<Vec<Vec<Neighbor>>, Error> {
        let rows = rows.chunks_exact(self.index.space().coordinates());
        let found = self.index.search_many(rows, &Search::k(k))?;
        Ok(found.into_iter().map(|found| found.neighbors).collect())
    }

    fn ids(&self, most: usize) -> Result<Vec<u64>, Error> {
        let points = self.index.scan()?.take(most);
        points.map(|point| Ok(point?.id)).collect()
    }

    fn remove_tagged(&self, tag: u64) -> Result<u64, Error> {
        let mut removed = 0;
        for point in self.index.scan()? {
            let point = point?;
            if point.tag == tag {
                removed += u64::from(self.index.remove(point.id)?);
            }
        }
        self.index.flush()?;
        Ok(removed)
    }

    /// Closes the index too: it takes no more writes.
    fn settle(&mut self) -> u64 {
        // A flush fails once the server has refused a write; the close returns those writes.
        let _ = self.index.flush();
        self.refused += self.index.take_unsent().len() as u64;
        self.refused += self.index.close(self.timeout).len() as u64;
        self.refused
    }
}

#[cfg(feature = "zenoh")]
fn over_zenoh(
    address: &Address,
    prefix: &str,
    index: &str,
    timeout: Duration,
) -> Result<wayfold::OpenShared, LoadError> {
    use zenoh::{Config, Wait};

    let locator = &address.server;
    let config = serde_json::json!({
        "mode": "client",
        "connect": { "endpoints": [locator] },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "transport": {
            // A time of 0 would refuse every server.
            "unicast": { "open_timeout": timeout.as_millis().max(1) },
            "link": { "tls": address.zenoh_tls },
        },
    });
    let failed = |error: zenoh::Error| {
        // The rest names a line of Zenoh's source.
        let text = error.to_string();
        let problem = text.split(" at /").next().unwrap_or_default();
        LoadError::Session {
            locator: locator.to_owned(),
            timeout,
            problem: problem.trim_end_matches(['!', ' ']).to_owned(),
        }
    };
    let config = Config::from_json5(&config.to_string()).map_err(failed)?;
    let session = zenoh::open(config).wait().map_err(failed)?;
    Ok(Index::shared_over_zenoh(session, prefix, index))
}

#[cfg(not(feature = "zenoh"))]
fn over_zenoh(
    _: &Address,
    _: &str,
    _: &str,
    _: Duration,
) -> Result<wayfold::OpenShared, LoadError> {
    Err(LoadError::NoZenoh)
}
