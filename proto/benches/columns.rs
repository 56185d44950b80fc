//! Columns of numbers as packed doubles, as the contract has them, against the same bytes declared as `bytes`: encoding
//! and decoding, to and from a `Vec<f64>`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use prost::{Message, bytes::Bytes};
use wayfold_proto::v1;

/// Numbers of a row: SE(3).
const WIDTH: usize = 7;

/// Neighbours of a row.
const K: usize = 10;

/// `States` with little-endian bytes in the place of numbers: the same on the wire.
#[derive(Clone, PartialEq, Message)]
struct ByteStates {
    #[prost(uint32, tag = "1")]
    row_count: u32,
    #[prost(bytes = "bytes", tag = "2")]
    coordinates: Bytes,
}

/// The columns of `Neighbors` that always travel, the distances as little-endian bytes.
#[derive(Clone, PartialEq, Message)]
struct ByteNeighbors {
    #[prost(uint32, repeated, tag = "1")]
    neighbor_counts: Vec<u32>,
    #[prost(fixed64, repeated, tag = "2")]
    ids: Vec<u64>,
    #[prost(bytes = "bytes", tag = "3")]
    distances: Bytes,
}

fn to_bytes(numbers: &[f64]) -> Bytes {
    let mut bytes = Vec::with_capacity(8 * numbers.len());
    for number in numbers {
        bytes.extend_from_slice(&number.to_le_bytes());
    }
    bytes.into()
}

fn to_numbers(bytes: &[u8]) -> Vec<f64> {
    let (chunks, _) = bytes.as_chunks();
    chunks.iter().copied().map(f64::from_le_bytes).collect()
}

fn numbers(count: usize) -> Vec<f64> {
    (0..count).map(|at| (at as f64).sqrt()).collect()
}

fn states(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("states");
    for rows in [100, 1000] {
        let coordinates = numbers(rows * WIDTH);
        group.throughput(Throughput::Bytes(8 * coordinates.len() as u64));
        let rows = rows as u32;
        group.bench_with_input(
            BenchmarkId::new("doubles", rows),
            &coordinates,
            |b, coordinates| {
                b.iter(|| {
                    let message = v1::States {
                        row_count: rows,
                        coordinates: coordinates.clone(),
                    };
                    let wire = Bytes::from(black_box(message).encode_to_vec());
                    v1::States::decode(black_box(wire)).map(|read| read.coordinates)
                });
            },
        );
        group.bench_with_input(
            BenchmarkId::new("bytes", rows),
            &coordinates,
            |b, coordinates| {
                b.iter(|| {
                    let message = ByteStates {
                        row_count: rows,
                        coordinates: to_bytes(coordinates),
                    };
                    let wire = Bytes::from(black_box(message).encode_to_vec());
                    let read = ByteStates::decode(black_box(wire));
                    read.map(|read| to_numbers(&read.coordinates))
                });
            },
        );
    }
    group.finish();
}

fn neighbors(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("neighbors");
    for rows in [100, 1000] {
        let distances = numbers(rows * K);
        let ids: Vec<u64> = (0..distances.len() as u64).collect();
        let counts = vec![K as u32; rows];
        group.throughput(Throughput::Bytes(16 * distances.len() as u64));
        group.bench_function(BenchmarkId::new("doubles", rows), |b| {
            b.iter(|| {
                let message = v1::Neighbors {
                    neighbor_counts: counts.clone(),
                    ids: ids.clone(),
                    distances: distances.clone(),
                    ..Default::default()
                };
                let wire = Bytes::from(black_box(message).encode_to_vec());
                let read = v1::Neighbors::decode(black_box(wire));
                read.map(|read| (read.neighbor_counts, read.ids, read.distances))
            });
        });
        group.bench_function(BenchmarkId::new("bytes", rows), |b| {
            b.iter(|| {
                let message = ByteNeighbors {
                    neighbor_counts: counts.clone(),
                    ids: ids.clone(),
                    distances: to_bytes(&distances),
                };
                let wire = Bytes::from(black_box(message).encode_to_vec());
                let read = ByteNeighbors::decode(black_box(wire));
                read.map(|read| (read.neighbor_counts, read.ids, to_numbers(&read.distances)))
            });
        });
    }
    group.finish();
}

criterion_group!(columns, states, neighbors);
criterion_main!(columns);
