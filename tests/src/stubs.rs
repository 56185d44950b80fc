//! The connected stubs, and the columns of their messages.

use tonic::transport::{Channel, Endpoint};
use wayfold_proto::v1::{
    self, CreateIndexRequest, DeleteIndexRequest, GetIndexRequest, GetRequest, InsertRequest,
    InsertResponse, KnnRequest, Neighbors, create_index_request::SpaceForm,
    index_service_client::IndexServiceClient, knn_request, neighbor_spec,
    point_service_client::PointServiceClient,
};

/// Both services over one connection. Clones share it.
#[derive(Clone, Debug)]
pub struct Stubs {
    /// `IndexService`.
    pub indexes: IndexServiceClient<Channel>,
    /// `PointService`.
    pub points: PointServiceClient<Channel>,
}

impl Stubs {
    /// Connects.
    ///
    /// # Panics
    /// If nothing listens there.
    pub async fn connect(uri: &str) -> Self {
        Self::try_connect(uri).await.expect("a server")
    }

    /// Connects if something listens there.
    ///
    /// # Errors
    /// The error of the connection.
    ///
    /// # Panics
    /// If it is not a URI.
    pub async fn try_connect(uri: &str) -> Result<Self, tonic::transport::Error> {
        Self::open(&Channel::from_shared(uri.to_owned()).expect("a URI")).await
    }

    /// Connects to an endpoint with options of its own.
    ///
    /// # Errors
    /// The error of the connection.
    pub async fn open(endpoint: &Endpoint) -> Result<Self, tonic::transport::Error> {
        let endpoint = endpoint.clone().tcp_nodelay(true);
        let channel = endpoint.connect().await?;
        Ok(Self {
            indexes: IndexServiceClient::new(channel.clone()),
            points: PointServiceClient::new(channel),
        })
    }

    /// Creates an index of the space in text form.
    ///
    /// # Panics
    /// If it is refused.
    pub async fn create(&mut self, name: &str, space: &str) -> v1::Index {
        let request = CreateIndexRequest {
            name: name.to_owned(),
            space_form: Some(SpaceForm::SpaceText(space.to_owned())),
            ..Default::default()
        };
        let response = self.indexes.create_index(request).await;
        let index = response.expect("an index").into_inner().index;
        index.expect("a description")
    }

    /// Waits until the server knows an index that another one has created.
    pub async fn find(&mut self, name: &str) {
        let request = GetIndexRequest {
            index_name: name.to_owned(),
        };
        while self.indexes.get_index(request.clone()).await.is_err() {
            tokio::task::yield_now().await;
        }
    }

    /// The number of a revision that has every mutation that was acknowledged before the call.
    ///
    /// # Errors
    /// The refusal.
    pub async fn latest(&mut self, name: &str) -> Result<u64, tonic::Status> {
        let request = GetRequest {
            index_name: name.to_owned(),
            latest: true,
            ..Default::default()
        };
        let answer = self.points.get(request).await?;
        Ok(number(&answer.into_inner().revision))
    }

    /// Describes an index.
    ///
    /// # Panics
    /// If it is refused.
    pub async fn describe(&mut self, name: &str) -> v1::Index {
        let index = name.to_owned();
        let response = self
            .indexes
            .get_index(GetIndexRequest { index_name: index })
            .await;
        let index = response.expect("an index").into_inner().index;
        index.expect("a description")
    }

    /// Deletes an index.
    ///
    /// # Panics
    /// If it is refused.
    pub async fn delete(&mut self, name: &str) {
        let request = DeleteIndexRequest {
            index_name: name.to_owned(),
            ..Default::default()
        };
        let response = self.indexes.delete_index(request).await;
        response.expect("an index to delete");
    }

    /// Inserts.
    ///
    /// # Panics
    /// If it is refused.
    pub async fn insert(&mut self, request: InsertRequest) -> InsertResponse {
        let response = self.points.insert(request).await;
        response.expect("an accepted insert").into_inner()
    }
}

/// A revision in the form of requests.
pub fn revision(uid: &str, number: u64) -> Option<v1::Revision> {
    let uid = uid.to_owned();
    Some(v1::Revision { uid, number })
}

/// The number of an answer's revision.
///
/// # Panics
/// If there is none.
pub fn number(revision: &Option<v1::Revision>) -> u64 {
    revision.as_ref().expect("a revision").number
}

/// The k nearest of each row of an insert.
pub fn k_nearest(k: u32) -> v1::NeighborSpec {
    v1::NeighborSpec {
        k_form: Some(neighbor_spec::KForm::K(k)),
        ..Default::default()
    }
}

/// All columns.
pub const INCLUDE_ALL: v1::Include = v1::Include {
    with_states: true,
    with_tags: true,
    with_revisions: true,
    with_payloads: true,
};

/// Rows of coordinates as a message.
pub fn row_states(rows: &[f64], coordinates: usize) -> v1::States {
    v1::States {
        row_count: u32::try_from(rows.len() / coordinates).expect("a row count"),
        coordinates: rows.to_vec(),
    }
}

/// An insert of rows of coordinates.
pub fn insert_request(index: &str, rows: &[f64], coordinates: usize) -> InsertRequest {
    InsertRequest {
        index_name: index.to_owned(),
        states: Some(row_states(rows, coordinates)),
        ..Default::default()
    }
}

/// A search for the k nearest of each row of coordinates.
pub fn knn_request(index: &str, rows: &[f64], coordinates: usize, k: u32) -> KnnRequest {
    KnnRequest {
        index_name: index.to_owned(),
        states: Some(row_states(rows, coordinates)),
        k_form: Some(knn_request::KForm::K(k)),
        ..Default::default()
    }
}

/// The (id, distance) pairs of each state.
///
/// # Panics
/// If the columns disagree.
pub fn neighbor_rows(neighbors: &Neighbors) -> Vec<Vec<(u64, f64)>> {
    assert_eq!(neighbors.ids.len(), neighbors.distances.len());
    let mut pairs = neighbors.ids.iter().zip(&neighbors.distances);
    let rows = neighbors.neighbor_counts.iter().map(|&count| {
        let row = pairs.by_ref().take(count as usize);
        row.map(|(&id, &distance)| (id, distance)).collect()
    });
    let rows: Vec<Vec<_>> = rows.collect();
    assert_eq!(pairs.len(), 0, "more neighbours than counted");
    rows
}

/// The bits of floats, for comparisons that distinguish -0 from 0.
pub fn bits(numbers: &[f64]) -> Vec<u64> {
    numbers.iter().map(|number| number.to_bits()).collect()
}
