//! Servers in other processes, called over loopback with 64 calls in flight.

use std::{fs, path::Path};

use tokio::task::JoinSet;
use wayfold::{Client, Credentials, IndexHandle};
use wayfold_tests::{
    ServerProcess, States,
    figures::{self, median},
    measuring,
};

use crate::{Added, INDEX, K, POINTS, SPACE, TOKEN, WIDTH};

/// The calls of a turn, and the turns of a round.
const CALLS: usize = 2_048;
const IN_FLIGHT: usize = 64;
const TURNS: usize = 60;

/// A server, and the handle that calls it.
struct Contestant {
    server: ServerProcess,
    index: IndexHandle,
}

impl Contestant {
    /// A server with identities and metrics, or without.
    async fn start(identities: Option<&Path>, rows: &[f64]) -> Self {
        let mut arguments = vec!["--grpc", "127.0.0.1:0", "--data", "memory"];
        let config;
        let mut credentials = Credentials::new();
        if let Some(file) = identities {
            let text = format!("[access]\nidentities = {:?}\n", file.display().to_string());
            let path = file.with_file_name("wayfold.toml");
            fs::write(&path, text).expect("a file");
            config = path.display().to_string();
            arguments.extend(["--config", &config, "--http", "127.0.0.1:0"]);
            credentials = credentials.token(TOKEN);
        }
        let server = measuring::start("server", &arguments);
        let client = Client::builder().credentials(credentials);
        let client = client.connect(server.uri()).await.expect("a server");
        let space = SPACE.parse().expect("a space");
        let index = client.create_index(INDEX, &space).await;
        let index = index.expect("an index");
        index
            .insert(rows.chunks(WIDTH))
            .await
            .expect("stored points");
        Self { server, index }
    }

    /// The server's processor time for a call of this turn.
    async fn turn_us(&self, queries: &[f64]) -> f64 {
        let process = self.server.process().id();
        let before = figures::processor_time(process).expect("Linux's /proc");
        let mut callers = JoinSet::new();
        for rows in queries.chunks(CALLS / IN_FLIGHT * WIDTH) {
            let (index, rows) = (self.index.clone(), rows.to_vec());
            callers.spawn(async move {
                for row in rows.chunks(WIDTH) {
                    let found = index.knn([row]).k(K).await.expect("neighbours");
                    assert_eq!(found.row(0).len(), K as usize);
                }
            });
        }
        callers.join_all().await;
        let taken = figures::processor_time(process).expect("Linux's /proc") - before;
        taken.as_secs_f64() * 1e6 / CALLS as f64
    }
}

pub(crate) async fn measure(identities: &Path, rounds: usize) -> Vec<(&'static str, Added)> {
    let (mut both, mut nothing) = (Added::default(), Added::default());
    for round in 0..rounds {
        let mut states = States::new(SPACE.parse().expect("a space"), round as u64);
        let rows = states.rows(POINTS);
        // New processes for each round: where memory lies makes a difference that stays as long as a process.
        let contestants = [
            Contestant::start(None, &rows).await,
            Contestant::start(Some(identities), &rows).await,
            Contestant::start(None, &rows).await,
        ];
        let mut of_round = [Vec::new(), Vec::new()];
        for turn in 0..TURNS {
            let queries = states.rows(CALLS);
            let mut took = [0.0; 3];
            for at in 0..took.len() {
                let at = (at + turn) % took.len();
                took[at] = contestants[at].turn_us(&queries).await;
            }
            both.push(took[1], took[0]);
            nothing.push(took[2], took[0]);
            of_round[0].push(took[1] - took[0]);
            of_round[1].push(took[2] - took[0]);
        }
        let [both, nothing] = of_round.map(median);
        eprintln!("round {round}: both {both:.2} us, nothing {nothing:.2} us");
    }
    vec![("both", both), ("nothing", nothing)]
}
