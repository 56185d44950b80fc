//! `Knn` and `Query`: the k nearest points of each state, and all points within a radius of each.

use wayfold_index::Search;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{AnswerBudget, NeighborColumns},
    call::TimeSlicer,
    check::{self, Rows, Violations},
    neighbor_spec::NeighborSpec,
    read_view::{ReadView, revision, revision_number, uid_of},
    stored::BATCH_ROWS,
};
use crate::identity::Role;

const DOING: &str = "while searching";

/// The most bytes of a neighbour without its state and payload: id, distance, tag, revision.
const NEIGHBOR_BYTES: usize = 8 + 8 + 8 + 10;

/// The request of either verb.
struct NeighborRequest {
    index: String,
    states: Option<v1::States>,
    spec: v1::NeighborSpec,
    epsilon: f64,
    min_revision: Option<v1::Revision>,
    latest: bool,
    /// A required field that is not set, and how to set it.
    missing: Option<(&'static str, &'static str)>,
}

impl Service {
    /// The k nearest points of each state, optionally within a radius.
    pub async fn knn(
        &self,
        call: &Call,
        request: v1::KnnRequest,
    ) -> Result<v1::KnnResponse, Error> {
        let missing = ("k", "set k or k_factor");
        let request = NeighborRequest {
            index: request.index_name,
            states: request.states,
            missing: request.k_form.is_none().then_some(missing),
            spec: v1::NeighborSpec {
                k_form: request.k_form.map(Into::into),
                radius_form: request.radius_form.map(Into::into),
                filter: request.filter,
                include: request.include,
            },
            epsilon: request.epsilon,
            min_revision: request.min_revision,
            latest: request.latest,
        };
        let (neighbors, revision) = self.neighbors(call, request).await?;
        Ok(v1::KnnResponse {
            neighbors: Some(neighbors),
            revision: Some(revision),
        })
    }

    /// The most bytes of the answer to `request`, as far as the request alone tells.
    pub(crate) fn most_answer_bytes(&self, request: &v1::KnnRequest) -> usize {
        let most = self.limits().max_answer_bytes;
        let include = request.include.unwrap_or_default();
        let (Some(v1::knn_request::KForm::K(k)), false) = (&request.k_form, include.with_payloads)
        else {
            return most;
        };
        let (rows, coordinates) = request.states.as_ref().map_or((0, 0), |states| {
            (states.row_count as usize, states.coordinates.len())
        });
        let bytes = rows.saturating_mul(NEIGHBOR_BYTES);
        let bytes = match include.with_states {
            true => bytes.saturating_add(coordinates.saturating_mul(8)),
            false => bytes,
        };
        bytes.saturating_mul(*k as usize).min(most)
    }

    /// All points within a radius of each state, the closed ball, nearest first.
    pub async fn query(
        &self,
        call: &Call,
        request: v1::QueryRequest,
    ) -> Result<v1::QueryResponse, Error> {
        let missing = (
            "radius",
            "set radius or scaled_radius; an infinite radius finds all points",
        );
        let request = NeighborRequest {
            index: request.index_name,
            states: request.states,
            missing: request.radius_form.is_none().then_some(missing),
            spec: v1::NeighborSpec {
                k_form: None,
                radius_form: request.radius_form.map(Into::into),
                filter: request.filter,
                include: request.include,
            },
            epsilon: request.epsilon,
            min_revision: request.min_revision,
            latest: request.latest,
        };
        let (neighbors, revision) = self.neighbors(call, request).await?;
        Ok(v1::QueryResponse {
            neighbors: Some(neighbors),
            revision: Some(revision),
        })
    }

    /// Checks a request, waits for its revision, and searches for every state.
    async fn neighbors(
        &self,
        call: &Call,
        request: NeighborRequest,
    ) -> Result<(v1::Neighbors, v1::Revision), Error> {
        let uid = uid_of(request.min_revision.as_ref());
        let hosted = self.index(call, Role::Read, &request.index, uid)?;
        let (limits, space) = (self.limits(), hosted.space());
        let mut pace = call.pace(DOING);
        let mut violations = Violations::default();
        if let Some((field, text)) = request.missing {
            violations.add(field, "REQUIRED", text);
        }
        let include = request.spec.include;
        let mut spec = NeighborSpec::check("", request.spec, &hosted, limits, &mut violations)?;
        check::finite("epsilon", request.epsilon, &mut violations);
        spec.fixed.epsilon = request.epsilon;
        let min = request.min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        let states =
            check::states(space, request.states, limits, &mut pace, &mut violations).await?;
        violations.finish()?;

        let min = min.max(spec.fixed.filter.since_revision);
        let published = self.published(call, &hosted, min, request.latest);
        let published = published.await?;
        let mut completed = spec.among(published.snapshot.len())?;
        completed.until = call.deadline;
        let view = ReadView {
            call,
            doing: DOING,
            index: hosted.name(),
            published: &published,
        };
        let budget = AnswerBudget::new(limits, call);
        let found = NeighborColumns::new(include, space.coordinates(), budget);
        let neighbors = search(&view, &states, completed, found, &mut pace).await?;
        Ok((neighbors, revision(&hosted, published.revision)))
    }
}

/// Searches for every state.
async fn search(
    view: &ReadView<'_>,
    states: &Rows,
    search: Search<'_>,
    mut found: NeighborColumns,
    pace: &mut TimeSlicer,
) -> Result<v1::Neighbors, Error> {
    let snapshot = &view.published.snapshot;
    for state in states.iter() {
        let search = Search {
            k: search.k.min(found.too_many()),
            ..search
        };
        let answer = snapshot.search(state, &search)?;
        found.push(|id| snapshot.get(id), &answer.neighbors)?;
        if found.without_payload().len() >= BATCH_ROWS {
            read_payloads(view, &mut found).await?;
        }
        pace.step().await?;
    }
    read_payloads(view, &mut found).await?;
    Ok(found.finish())
}

/// Adds all missing payloads.
async fn read_payloads(view: &ReadView<'_>, found: &mut NeighborColumns) -> Result<(), Error> {
    while !found.without_payload().is_empty() {
        let batch = found.without_payload().iter().take(BATCH_ROWS);
        let batch = batch.copied().collect();
        let budget = &mut found.budget;
        let most = budget.left;
        let payloads = view.payloads(batch, most, &mut budget.held).await?;
        for payload in payloads {
            found.push_payload(payload)?;
        }
    }
    Ok(())
}
