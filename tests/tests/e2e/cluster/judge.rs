//! Judges a round: by the model, which computes every answer, and by the checkers of histories.

use std::{collections::BTreeSet, time::Instant};

use tokio::time::timeout;
use tonic::Status;
use wayfold_proto::v1::{
    VerifyIndexRequest, VerifyReport, verify_index_response::Result as Verified,
};
use wayfold_tests::{
    Content, Model, Stubs,
    history::{
        Checked, Operation, check,
        names::{self, NameOperation, NamesChecked},
    },
    ledger::Entry,
    number, revision,
};

use super::{
    MAX_PAUSE, WRITERS,
    client::Client,
    follower::{Follower, Following},
    history::{History, scan},
    maker::Maker,
    names::settled,
};
use crate::{
    clients::{SPACE, Tally},
    healing::latest_content,
};

/// The judge of an index.
pub(super) struct Judge {
    history: History,
    uid: String,
}

/// The judgement.
#[derive(Debug, Default)]
pub(super) struct Verdict {
    pub(super) acknowledged: u64,
    /// The counts of the checker of histories.
    pub(super) checked: Checked,
    /// The times that the follower began again, because a server no longer kept its next record.
    pub(super) resets: u64,
    /// What the checker of names counted.
    pub(super) names: NamesChecked,
    pub(super) lost: u64,
    pub(super) twice: u64,
    /// The differences after each fault and at the end: a server differs from the first one, searches other points than it
    /// stores, or does not answer; the follower lacks records; or the servers do not agree on the index of the makers.
    pub(super) divergent: u64,
    /// The refusals that said that NATS has lost something.
    pub(super) data_losses: u64,
    /// The contradictions of the history.
    pub(super) violations: Vec<String>,
    /// Those of the calls for the index of the makers.
    pub(super) name_violations: Vec<String>,
}

/// Those who saw the round.
pub(super) struct Witnesses {
    pub(super) clients: Vec<Client>,
    pub(super) makers: Vec<Maker>,
    pub(super) following: Following,
}

impl Verdict {
    pub(super) fn is_good(&self) -> bool {
        self.lost + self.twice + self.divergent == 0 && self.violations.is_empty()
    }

    fn check(&mut self, operations: &[Operation], named: &[NameOperation]) {
        match check(operations) {
            Ok(checked) => self.checked = checked,
            Err(violations) => self.violations = first(&violations),
        }
        match names::check(named) {
            Ok(checked) => self.names = checked,
            Err(violations) => self.name_violations = first(&violations),
        }
    }

    fn count(&mut self, follower: &Follower, makers: &[Maker], clients: &[Client]) {
        self.resets = follower.resets;
        let of_makers = makers.iter().map(|it| it.data_losses);
        let of_clients = clients.iter().map(|it| it.data_losses);
        self.data_losses = follower.data_losses + of_makers.chain(of_clients).sum::<u64>();
    }
}

/// The first contradictions as text.
fn first(violations: &[impl std::fmt::Debug]) -> Vec<String> {
    let violations = violations.iter().take(10);
    violations.map(|it| format!("{it:?}")).collect()
}

impl Judge {
    pub(super) fn new(history: History, uid: String) -> Self {
        Self { history, uid }
    }

    /// Settles what is unknown, and compares the servers with all that the clients saw.
    pub(super) async fn judge(&self, witnesses: Witnesses, uris: &[String]) -> Verdict {
        let Witnesses {
            mut clients,
            mut makers,
            following,
        } = witnesses;
        let mut stubs = Stubs::connect(&uris[0]).await;
        let (mut entries, mut operations) = (Vec::new(), Vec::new());
        for client in &mut clients {
            let writer = &mut client.writer;
            let asked = async { while !writer.ask_again(&mut stubs).await {} };
            let asked = timeout(MAX_PAUSE, asked).await;
            assert!(asked.is_ok(), "{:?}", writer.refusal);
            operations.append(&mut client.reads);
            let conflicts = writer.conflicts.iter();
            operations.extend(conflicts.map(|it| self.history.conflict(writer.name, it)));
            for acknowledged in writer.ledger.drain(..) {
                operations.push(self.history.mutation(writer.name, &acknowledged));
                entries.push(acknowledged.entry);
            }
        }
        entries.sort_by_key(|entry| (entry.revision(), !entry.changed()));
        let mut verdict = Verdict::default();
        let contents = self.contents(&mut stubs, uris, &mut operations).await;
        let differ = |content: &&Option<Content>| content.is_none() || **content != contents[0];
        verdict.divergent = contents.iter().filter(differ).count() as u64;
        let newest = contents.iter().flatten().map(|it| it.revision).max();
        let reaches = following.reaches(newest.unwrap_or_default()).await;
        verdict.divergent += u64::from(!reaches);
        let mut named = Vec::new();
        for maker in &mut makers {
            named.append(&mut maker.operations);
        }
        match settled(uris, self.history).await {
            Some(settled) => named.extend(settled),
            None => verdict.divergent += 1,
        }
        let mut follower = following.end().await;
        operations.append(&mut follower.seen);
        verdict.count(&follower, &makers, &clients);
        let mut tally = Tally::default();
        for entry in &entries {
            tally.note(entry);
        }
        verdict.acknowledged = tally.acknowledged;
        for content in contents.iter().flatten() {
            tally.count(content);
        }
        (verdict.lost, verdict.twice) = (tally.lost, tally.duplicated);
        verdict.check(&operations, &named);
        if verdict.is_good() {
            check_model(&entries, &contents);
        }
        verdict
    }

    /// The same while JetStream has stopped for good: nothing is settled, and servers may be behind the newest of them.
    pub(super) async fn judge_reads(&self, witnesses: Witnesses, uris: &[String]) -> Verdict {
        let Witnesses {
            mut clients,
            mut makers,
            following,
        } = witnesses;
        let mut verdict = Verdict::default();
        let mut follower = following.end().await;
        verdict.count(&follower, &makers, &clients);
        let (mut operations, mut named) = (Vec::new(), Vec::new());
        operations.append(&mut follower.seen);
        for maker in &mut makers {
            named.append(&mut maker.operations);
        }
        for client in &mut clients {
            let writer = &client.writer;
            operations.append(&mut client.reads);
            let conflicts = writer.conflicts.iter();
            operations.extend(conflicts.map(|it| self.history.conflict(writer.name, it)));
            verdict.acknowledged += writer.ledger.len() as u64;
            let ledger = writer.ledger.iter();
            operations.extend(ledger.map(|it| self.history.mutation(writer.name, it)));
            if let Some((entry, invoked)) = writer.unknown() {
                operations.push(self.history.unknown(writer.name, &entry, invoked));
            }
        }
        let mut contents = Vec::new();
        let invoked = Instant::now();
        for uri in uris {
            let stubs = Stubs::connect(uri).await;
            contents.push(Content::read(&stubs, "arm").await.expect("reads go on"));
        }
        let newest = contents.iter().map(|it| it.revision).max();
        for (server, content) in contents.iter().enumerate() {
            // All that was acknowledged is in the newest copy.
            let is_newest = Some(content.revision) == newest;
            let (read, reader) = (scan(is_newest, content), WRITERS + server as u64);
            let read = self
                .history
                .operation(reader, invoked, Instant::now(), read);
            operations.push(read);
        }
        verdict.check(&operations, &named);
        verdict
    }

    /// Counts the differences while nobody calls, as in [`Verdict::divergent`]. It returns none if the first server does not
    /// answer a read with `latest`.
    pub(super) async fn compare(&self, uris: &[String], following: &Following) -> Option<u64> {
        let mut first = Stubs::connect(&uris[0]).await;
        loop {
            let latest = async {
                loop {
                    if let Ok(newest) = first.latest("arm").await {
                        return newest;
                    }
                }
            };
            let newest = timeout(MAX_PAUSE, latest).await.ok()?;
            let mut reports = Vec::new();
            for uri in uris {
                let stubs = Stubs::connect(uri).await;
                reports.push(self.verified(&stubs, newest).await);
            }
            let described = reports.iter().flatten().flat_map(|it| &it.index);
            let revisions: BTreeSet<u64> = described.map(|it| number(&it.revision)).collect();
            // The record of a call without an answer may arrive meanwhile.
            if revisions.len() > 1 {
                continue;
            }
            let hashes = reports.iter().map(|it| Some(&it.as_ref()?.content_hash));
            let hashes: Vec<_> = hashes.collect();
            let differs = |hash: &&Option<_>| hash.is_none() || **hash != hashes[0];
            let differing = hashes.iter().filter(differs).count() as u64;
            return Some(differing + u64::from(!following.reaches(newest).await));
        }
    }

    /// The report of `VerifyIndex` at a server that has reached a revision; None if it searches other points than it stores, or
    /// does not get there.
    async fn verified(&self, stubs: &Stubs, newest: u64) -> Option<VerifyReport> {
        let request = VerifyIndexRequest {
            index_name: "arm".into(),
            min_revision: revision(&self.uid, newest),
            ..Default::default()
        };
        let answered = async {
            loop {
                if let Ok(report) = verify(stubs, request.clone()).await {
                    return report;
                }
            }
        };
        let Ok(report) = timeout(MAX_PAUSE, answered).await else {
            println!("a server does not reach revision {newest}");
            return None;
        };
        if report.disagreement_count > 0 {
            println!("a server searches other points than it stores: {report:?}");
            return None;
        }
        Some(report)
    }

    /// The contents of all servers, at a revision that has everything; none of a server that does not answer.
    async fn contents(
        &self,
        stubs: &mut Stubs,
        uris: &[String],
        operations: &mut Vec<Operation>,
    ) -> Vec<Option<Content>> {
        // Retries may have left records without effect behind the last mutation, and this server may not have them yet.
        let newest = latest_content(stubs).await.revision;
        let mut contents = Vec::new();
        for (server, uri) in uris.iter().enumerate() {
            let (stubs, invoked) = (Stubs::connect(uri).await, Instant::now());
            if self.verified(&stubs, newest).await.is_none() {
                contents.push(None);
                continue;
            }
            let content = Content::read(&stubs, "arm").await.unwrap();
            let (read, reader) = (scan(false, &content), WRITERS + server as u64);
            let read = self
                .history
                .operation(reader, invoked, Instant::now(), read);
            operations.push(read);
            contents.push(Some(content));
        }
        contents
    }
}

async fn verify(stubs: &Stubs, request: VerifyIndexRequest) -> Result<VerifyReport, Status> {
    let mut parts = stubs
        .indexes
        .clone()
        .verify_index(request)
        .await?
        .into_inner();
    while let Some(part) = parts.message().await? {
        if let Some(Verified::Report(report)) = part.result {
            return Ok(report);
        }
    }
    Err(Status::internal("a verification without a report"))
}

/// Compares every answer and the contents with brute force.
fn check_model(entries: &[Entry], contents: &[Option<Content>]) {
    let mut model = Model::new(SPACE.parse().unwrap());
    for entry in entries {
        model.skip_to(entry.revision() - u64::from(entry.changed()));
        model.check(entry);
    }
    for content in contents.iter().flatten() {
        assert!(content.revision >= model.revision());
        model.skip_to(content.revision);
        model.check_content(content);
    }
}
