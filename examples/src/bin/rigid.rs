//! A chair through three rooms, several times, on one roadmap that several processes build together: PRM* for a rigid
//! body with six degrees of freedom, the kind of experiment of Fig. 10 in A. Yershova, S. M. LaValle, "Improving Motion
//! Planning Algorithms by Efficient Nearest-Neighbor Searching", IEEE Transactions on Robotics, 2007.
//!
//!     cargo run --release --bin rigid -- [--workers 4] [--source remote] [--kill | --restart]
//!     cargo run --release --bin rigid -- --scaling [--runs 5]
//!     cargo run --release --bin rigid -- --until-solved [--scaling] [--runs 5]
//!     cargo run --release --bin rigid -- --compare [--runs 5]

use std::{path::Path, process::ExitCode};

use clap::Parser;
use wayfold_examples::{
    planning::{
        error::{PlanningError, exit_code},
        figures,
        report::can_write,
        server::{self, ServerProcess},
    },
    rigid::{
        audit,
        build::{self, Built},
        options::{Options, ProcessCommand},
        picture, processes, report,
        scene::Rooms,
        sources, until_solved,
    },
};

fn main() -> ExitCode {
    if let Some(ended) = server::serve_if_requested() {
        return ended;
    }
    let options = Options::parse();
    // A worker computes and inserts on the main thread; the index has threads of its own.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build();
    let ended = match (runtime, &options.role) {
        (Err(error), _) => Err(PlanningError::Server(error)),
        // Its sources wait on their own threads.
        (Ok(_), None) if options.compare => sources::compare(&Rooms::new(), &options),
        (Ok(runtime), Some(ProcessCommand::Work { job })) => runtime.block_on(processes::work(job)),
        (Ok(runtime), Some(ProcessCommand::Audit(of))) => {
            runtime.block_on(audit::audit(&of.server, &of.index))
        }
        (Ok(runtime), None) => runtime.block_on(run(&options)),
    };
    exit_code(ended)
}

async fn run(options: &Options) -> Result<(), PlanningError> {
    let picture = Path::new("rigid.svg");
    let drawn = (!options.until_solved && !options.scaling).then_some(picture);
    can_write(options.json.as_deref().into_iter().chain(drawn))?;
    let mut own = match options.server {
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
        return figures::write(runs.iter().map(Built::row), options.json.as_deref());
    }
    let built = build::build(&scene, uri, own.as_mut(), options, options.seed).await?;
    print!("{}", report::table(&built));
    figures::write([built.row()], options.json.as_deref())?;
    picture::draw(&scene, &built, picture)
}
