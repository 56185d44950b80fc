//! What the servers have under the name of the makers' index while nobody calls.

use std::time::Instant;

use tokio::time::timeout;
use tonic::Code;
use wayfold_proto::v1::{GetIndexRequest, ScanRequest};
use wayfold_tests::{
    Content, INCLUDE_ALL, Stubs,
    history::{
        digest,
        names::{NameCall, NameOperation},
    },
    revision,
};

use super::{
    MAKERS, MAX_PAUSE,
    history::{History, scan},
    maker::NAME,
};

/// The uid that all servers have under the name, or none. They hear of a change one after the other; None if they do not come
/// to agree.
pub(super) async fn agreed(uris: &[String]) -> Option<Option<String>> {
    let mut servers = Vec::new();
    for uri in uris {
        servers.push(Stubs::connect(uri).await);
    }
    let agreed = async {
        loop {
            let mut uids = Vec::new();
            for stubs in &mut servers {
                uids.push(uid(stubs).await);
            }
            if let Ok(uid) = &uids[0]
                && uids.iter().all(|it| *it == uids[0])
            {
                return uid.clone();
            }
        }
    };
    let agreed = timeout(MAX_PAUSE, agreed).await.ok();
    if agreed.is_none() {
        println!("the servers do not agree on the index {NAME}");
    }
    agreed
}

async fn uid(stubs: &mut Stubs) -> Result<Option<String>, Code> {
    let request = GetIndexRequest {
        index_name: NAME.into(),
    };
    match stubs.indexes.get_index(request).await {
        Ok(response) => {
            let index = response.into_inner().index.expect("a description");
            Ok(Some(index.revision.expect("a revision").uid))
        }
        Err(refusal) if refusal.code() == Code::NotFound => Ok(None),
        Err(refusal) => Err(refusal.code()),
    }
}

/// Reads the index and its latest points at each server at the end. It returns none if the servers do not agree, or one does
/// not answer.
pub(super) async fn settled(uris: &[String], history: History) -> Option<Vec<NameOperation>> {
    let asked = Instant::now();
    let uid = agreed(uris).await?;
    let settled = NameCall::Settled(uid.clone());
    let mut operations = vec![history.named((MAKERS, 0), asked, Some(Instant::now()), settled)];
    let Some(uid) = uid else {
        return Some(operations);
    };
    for uri in uris {
        let request = ScanRequest {
            index_name: NAME.into(),
            include: Some(INCLUDE_ALL),
            min_revision: revision(&uid, 0),
            latest: true,
            ..Default::default()
        };
        let (stubs, invoked) = (Stubs::connect(uri).await, Instant::now());
        let read = async {
            loop {
                if let Ok(content) = Content::read_as(&stubs, request.clone()).await {
                    return content;
                }
            }
        };
        let content = timeout(MAX_PAUSE, read).await.ok()?;
        let (from, returned) = ((MAKERS, digest(uri)), Some(Instant::now()));
        let call = NameCall::Points(uid.clone(), scan(true, &content));
        operations.push(history.named(from, invoked, returned, call));
    }
    Some(operations)
}
