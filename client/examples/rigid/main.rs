//! A chair through three rooms, several times, on one roadmap that several processes build together: PRM* for a rigid body
//! with six degrees of freedom, the kind of experiment of Fig. 10 in A. Yershova, S. M. LaValle, "Improving Motion Planning
//! Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release -p wayfold --example rigid -- [--workers 4] [--source server] [--kill | --restart]
//!     cargo run --release -p wayfold --example rigid -- --scaling [--runs 5]
//!     cargo run --release -p wayfold --example rigid -- --until-solved [--scaling] [--runs 5]
//!     cargo run --release -p wayfold --example rigid -- --compare [--runs 5]
//!
//! Reading order: `milestone` (what the index keeps), `nearby` (its candidates), `worker` (the planner), `roadmap` (what all
//! of them made), `processes` (what one that is started does), `build` (one roadmap from the start to its paths), `until_solved`
//! (no further than its paths), `sources` (by one planner, with every source of neighbours), `replay` and `audit` (what a
//! roadmap must be), `report`, `picture`.

#[path = "../planning/mod.rs"]
mod planning;

mod account;
mod audit;
mod build;
mod milestone;
mod nearby;
mod options;
mod picture;
mod processes;
mod replay;
mod report;
mod roadmap;
mod scene;
mod solid;
mod sources;
mod until_solved;
mod worker;

use std::{path::Path, process::ExitCode};

use clap::Parser;
use options::{Options, Role};
use planning::{
    error::PlanningError,
    report::can_write,
    server::{self, ServerProcess},
};
use scene::Rooms;

fn main() -> ExitCode {
    if let Some(ended) = server::serve_if_told() {
        return ended;
    }
    let options = Options::parse();
    // Calls are made on the main thread, which computes between them; the replica follows on the other.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    let ended = match (runtime, &options.role) {
        (Err(error), _) => Err(PlanningError::Server(error)),
        // Its sources wait on threads of their own.
        (Ok(_), None) if options.compare => sources::compare(&Rooms::new(), &options),
        (Ok(runtime), Some(Role::Work(job))) => runtime.block_on(processes::work(job)),
        (Ok(runtime), Some(Role::Audit(of))) => {
            runtime.block_on(audit::audit(&of.server, &of.index))
        }
        (Ok(runtime), None) => runtime.block_on(run(&options)),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn run(options: &Options) -> Result<(), PlanningError> {
    let picture = Path::new("rigid.svg");
    let drawn = (!options.until_solved && !options.scaling).then_some(picture);
    can_write(options.json.as_deref().into_iter().chain(drawn))?;
    let mut own = match options.server {
        None if options.restart => Some(ServerProcess::durable()?),
        None => Some(ServerProcess::start()?),
        Some(_) => None,
    };
    let uri = own.as_ref().map(|own| own.uri().to_owned());
    let uri = &options.server.clone().or(uri).unwrap_or_default();
    let scene = Rooms::new();
    if options.until_solved {
        return until_solved::run(&scene, uri, options).await;
    }
    if options.scaling {
        let runs = build::compare(&scene, uri, options).await?;
        print!("{}", report::comparison(&runs));
        return report::write_json(&runs, options);
    }
    let built = build::build(&scene, uri, own.as_mut(), options, options.seed).await?;
    print!("{}", report::table(&built));
    report::write_json(std::slice::from_ref(&built), options)?;
    picture::draw(&scene, &built, picture)
}
