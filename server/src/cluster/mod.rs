//! The servers that share a journal know each other here: the live members, and the owner of each index. The calls from
//! server to server are made by [`MemberClient`].
//!
//! The owner of an index is chosen by rendezvous hashing over the live members. It evaluates the mutations that arrive at
//! any member, so that writers at several servers do not refuse each other. Nothing depends on it: the journal
//! accepts only the first of two records, and two servers that both believe to be the owner are only slower.

mod members;

use std::{
    net::SocketAddr,
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};

use bytes::Bytes;
use futures_util::future::BoxFuture;
use thiserror::Error;
use tokio::{sync::oneshot, time::timeout};
use tokio_util::task::AbortOnDropHandle;
use tracing::warn;

use self::members::Members;
use crate::{
    config::{ClusterConfig, OFF, TlsConfig},
    grpc::MemberClient,
    log::Uid,
    service::{
        Call, CopyParts, CopyRequest, NotForwarded, Owners, Peers, Service, StoredRequest,
        StoredResponse, Unanswered,
    },
};

/// The time in which a starting member heals its indices before it serves them as they are.
const HEAL_TIME: Duration = Duration::from_secs(60);

/// The server cannot be a member.
#[derive(Debug, Error)]
pub enum ClusterError {
    /// The listener has no address.
    #[error(
        "cannot listen on {listen} for the other servers of the cluster: {source}\n  choose another address with \
         cluster.listen (127.0.0.1:0 takes any free port)"
    )]
    Listener {
        /// The address.
        listen: String,
        /// The problem.
        source: std::io::Error,
    },
    /// Others cannot reach the address.
    #[error(
        "cluster.listen = {listen} is no address that other servers reach: name one of this server with \
         cluster.advertise"
    )]
    NoAddress {
        /// The address.
        listen: SocketAddr,
    },
}

/// The address at which the others reach a server that listens on `listen`.
pub(crate) fn advertised(
    config: &ClusterConfig,
    listen: SocketAddr,
) -> Result<String, ClusterError> {
    match &*config.advertise {
        OFF if listen.ip().is_unspecified() => Err(ClusterError::NoAddress { listen }),
        OFF => Ok(listen.to_string()),
        advertise => Ok(advertise.to_owned()),
    }
}

/// This server among the members of its cluster.
pub(crate) struct Cluster {
    nats: async_nats::Client,
    members: Members,
    client: MemberClient,
}

impl Cluster {
    /// Hears the members of the cluster from now on, until it is dropped. The server at the address `own` is one of them
    /// after [`Cluster::serve`].
    pub(crate) fn join(
        config: &ClusterConfig,
        tls: &TlsConfig,
        nats: async_nats::Client,
        own: String,
    ) -> Self {
        let subject = format!("{}.members", config.name);
        Self {
            members: Members::join(nats.clone(), subject, own),
            nats,
            client: MemberClient::new(config.peer_ca(), tls),
        }
    }

    /// Heals the indices of the service, and trims the journal, as long as the returned handles are held. The others may
    /// call this server once it has tried to heal the indices that it starts with, while it can read its store.
    pub(crate) async fn serve(self: &Arc<Self>, service: &Service) -> [AbortOnDropHandle<()>; 2] {
        let (tried, is_tried) = oneshot::channel();
        let peers = Arc::clone(self) as Arc<dyn Peers>;
        service.set_peers(Arc::clone(&peers));
        let healing = service.clone().heal(Arc::clone(&peers), tried);
        let healing = AbortOnDropHandle::new(tokio::spawn(healing));
        if timeout(HEAL_TIME, is_tried).await.is_err() {
            warn!("serving before all indices that cannot follow their journal are healed");
        }
        if let Some(fitness) = service.fitness() {
            self.members.serve(fitness);
        }
        let owners = Arc::clone(self) as Arc<dyn Owners>;
        let trimming = tokio::spawn(service.clone().trim_journal(owners, peers));
        [healing, AbortOnDropHandle::new(trimming)]
    }

    /// Tells the others that this server is about to stop, so that they do not forward to it any more.
    pub(crate) async fn leave(&self) {
        self.members.leave().await;
    }
}

impl Owners for Cluster {
    fn owner(&self, uid: Uid) -> Option<String> {
        self.members.owner(uid)
    }

    fn members(&self) -> usize {
        self.members.count()
    }

    fn changes(&self) -> u64 {
        // Both only grow, so that the sum is the same only if both are.
        self.members.changes() + self.nats.statistics().connects.load(Relaxed)
    }

    fn forward<'a>(
        &'a self,
        owner: &'a str,
        uid: Uid,
        rpc: &'static str,
        call: &'a Call,
        request: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, NotForwarded>> {
        Box::pin(async move {
            tokio::select! {
                answered = self.client.forward(owner, uid, rpc, call, request) => answered,
                () = self.members.silence(owner) => {
                    self.client.forget(owner);
                    Err(NotForwarded::Unknown { what: "it is not heard any more".into() })
                }
            }
        })
    }
}

impl Peers for Cluster {
    fn peers(&self, uid: Uid) -> Vec<String> {
        self.members.others(uid)
    }

    fn all(&self) -> Vec<String> {
        self.members.others(Uid::unique())
    }

    fn wait_for_members(&self) -> BoxFuture<'_, ()> {
        Box::pin(self.members.wait_for_members())
    }

    fn stored<'a>(
        &'a self,
        member: &'a str,
        request: StoredRequest,
    ) -> BoxFuture<'a, Result<StoredResponse, Unanswered>> {
        Box::pin(self.client.stored(member, request))
    }

    fn copy<'a>(
        &'a self,
        member: &'a str,
        request: CopyRequest,
    ) -> BoxFuture<'a, Result<CopyParts, Unanswered>> {
        Box::pin(self.client.copy(member, request))
    }
}
