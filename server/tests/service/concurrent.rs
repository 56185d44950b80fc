//! Concurrent writers of one index get the answers of the same calls made one by one in the order of their revisions,
//! whatever they prepared before their turn.

use wayfold_index::Space;
use wayfold_server::service::Service;

use crate::{
    model::Model,
    random::{Answer, Mutation, Requests},
    support::*,
};

const WRITERS: u64 = 6;
const CALLS: usize = 60;

async fn write(
    service: Service,
    mut requests: Requests,
    only_inserts: bool,
) -> Vec<(Mutation, Answer)> {
    let mut answered = Vec::new();
    for _ in 0..CALLS {
        let revision = info(&service, "arm").await.revision.number();
        let mutation = match only_inserts {
            true => Mutation::Insert(requests.insert(revision)),
            false => requests.mutation(revision, String::new()),
        };
        if let Ok(answer) = mutation.send(&service).await {
            answered.push((mutation, answer));
        }
    }
    answered
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn calls_at_once_are_calls_one_after_another() {
    for (seed, only_inserts) in [(1, true), (2, false), (3, false)] {
        println!("seed {seed}");
        let (service, uid) = arm("R2*SO2").await;
        let space: Space = "R2*SO2".parse().unwrap();
        let writers = (0..WRITERS).map(|writer| {
            let requests = Requests::new(100 * seed + writer, &space, &uid);
            tokio::spawn(write(service.clone(), requests, only_inserts))
        });
        let mut answered = Vec::new();
        for writer in writers.collect::<Vec<_>>() {
            answered.extend(writer.await.unwrap());
        }
        let mut model = Model::new(space, uid);
        let last = info(&service, "arm").await.revision.number();
        assert!(last > 50, "{last}");
        for revision in 1..=last {
            let of_it = answered
                .iter()
                .filter(|(_, answer)| answer.revision == revision);
            // One call made this revision; the others changed nothing after it.
            let (mut made, mut others) = (None, Vec::new());
            for (mutation, answer) in of_it {
                let mut next = model.clone();
                let is_it = made.is_none() && mutation.apply(&mut next).as_ref() == Ok(answer);
                match is_it {
                    true => made = Some(next),
                    false => others.push((mutation, answer)),
                }
            }
            model = made.unwrap_or_else(|| panic!("nothing makes revision {revision}"));
            assert_eq!(model.revision, revision);
            for (mutation, answer) in others {
                assert_eq!(mutation.apply(&mut model).as_ref(), Ok(answer));
            }
        }
        assert_eq!(model.revision, last);
    }
}
