//! Compares a roadmap on a server with the expected one.

use std::collections::BTreeMap;

use serde_json::json;
use wayfold::Client;

use super::{replay, roadmap::Roadmap, scene::Rooms};
use crate::planning::error::PlanningError;

/// The role of an auditor: it fails unless no milestone is pending and all edges equal those of the replay. It prints
/// the roadmap's figures as JSON.
pub async fn audit(server: &str, index: &str) -> Result<(), PlanningError> {
    let index = Client::connect(server).await?.index(index).await?;
    let roadmap = Roadmap::read(&index).await?;
    if let Some(at) = roadmap.pending.iter().position(|pending| *pending) {
        return Err(PlanningError::Replay {
            id: roadmap.ids[at],
            problem: "it is pending".to_owned(),
        });
    }
    let (stored, replayed) = (
        replay::stored(&roadmap),
        replay::edges(&Rooms::new(), &roadmap),
    );
    for ((id, stored), replayed) in roadmap.ids.iter().zip(&stored).zip(&replayed) {
        if stored != replayed {
            let problem = format!("its edges lead to {stored:?}, in a replay to {replayed:?}");
            return Err(PlanningError::Replay { id: *id, problem });
        }
    }
    let mut workers: BTreeMap<usize, u64> = BTreeMap::new();
    for &worker in &roadmap.workers {
        *workers.entry(worker).or_default() += 1;
    }
    let summary = json!({
        "milestones": roadmap.len(),
        "edges": roadmap.edge_count(),
        "workers": workers,
    });
    println!("{summary}");
    Ok(())
}
