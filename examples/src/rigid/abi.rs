//! The functions of the library `rigid-checks`. Their answers equal those of `scene`.
//!
//! A state is passed as a row of numbers and its length. A function returns [`NO_STATE`], and reads and writes nothing
//! more, if the row is null, has another length, or has a number that is not finite. All functions may be called from
//! several threads.

#![expect(
    unsafe_code,
    reason = "other languages give addresses, which only they can know to be right"
)]

use std::{
    ffi::{CString, c_char},
    slice,
    sync::LazyLock,
};

use serde_json::json;

use super::scene::Rooms;
use crate::planning::{path, problem::Problem};

static SCENE: LazyLock<Rooms> = LazyLock::new(Rooms::new);

/// Yes.
pub const FREE: i32 = 1;
/// No.
pub const NOT_FREE: i32 = 0;
/// The arguments are not states of this scene.
pub const NO_STATE: i32 = -1;

/// The description of the scene as JSON: the text of the space, the length of a state, the bounds of the real
/// coordinates, the resolution at which motions are checked, and the questions. The string stays valid until the
/// program ends.
#[unsafe(no_mangle)]
pub extern "C" fn rigid_problem() -> *const c_char {
    static TEXT: LazyLock<CString> = LazyLock::new(|| {
        let task = |task: &super::scene::Task| json!({"name": task.name, "start": task.start, "goal": task.goal});
        let tasks: Vec<_> = SCENE.tasks().iter().map(task).collect();
        let problem = json!({
            "space": SCENE.space().to_string(),
            "coordinates": SCENE.space().coordinates(),
            "bounds": SCENE.bounds(),
            "resolution": SCENE.resolution(),
            "tasks": tasks,
        });
        // JSON escapes a zero.
        CString::new(problem.to_string()).unwrap_or_default()
    });
    TEXT.as_ptr()
}

/// Makes a row canonical, as the server does. Returns [`FREE`], or [`NO_STATE`] if the row has no canonical form.
///
/// # Safety `row` is null or the address of `length` numbers that no other thread uses during the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rigid_canonicalize(row: *mut f64, length: usize) -> i32 {
    // Safety: as this function's.
    if unsafe { state(row, length) }.is_none() {
        return NO_STATE;
    }
    // Safety: it is not null, and this is the only reference to it.
    let row = unsafe { slice::from_raw_parts_mut(row, length) };
    match SCENE.space().canonicalize(row) {
        Ok(()) => FREE,
        Err(_) => NO_STATE,
    }
}

/// Returns whether a canonical state is free.
///
/// # Safety
/// `row` is null or the address of `length` numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rigid_is_free(row: *const f64, length: usize) -> i32 {
    // Safety: as this function's.
    match unsafe { state(row, length) } {
        Some(state) => as_flag(SCENE.is_free(state)),
        None => NO_STATE,
    }
}

/// Returns whether the motion between two free states is free; the ends are not checked. Adds the number of checked
/// states to `checks`, unless `checks` is null.
///
/// # Safety `a` and `b` are null or the addresses of `length` numbers, and `checks` is null or the address of a number
/// that no other thread uses during the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rigid_is_free_way(
    a: *const f64,
    b: *const f64,
    length: usize,
    checks: *mut u64,
) -> i32 {
    // Safety: as this function's.
    let (Some(a), Some(b)) = (unsafe { state(a, length) }, unsafe { state(b, length) }) else {
        return NO_STATE;
    };
    let mut checked = 0;
    let free = SCENE.is_free_way(a, b, &mut checked);
    // Safety: as this function's.
    if let Some(checks) = unsafe { checks.as_mut() } {
        *checks += checked;
    }
    as_flag(free)
}

/// The distance between two states in the space's metric; NaN unless both are states.
///
/// # Safety
/// `a` and `b` are null or the addresses of `length` numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rigid_distance(a: *const f64, b: *const f64, length: usize) -> f64 {
    // Safety: as this function's.
    match (unsafe { state(a, length) }, unsafe { state(b, length) }) {
        (Some(a), Some(b)) => SCENE.space().distance(a, b),
        _ => f64::NAN,
    }
}

/// Returns whether a path through `count` consecutive rows is free, by the finer, independent check with which `rigid`
/// verifies its own paths.
///
/// # Safety
/// `rows` is null or the address of `count` times `length` numbers.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rigid_is_free_path(rows: *const f64, count: usize, length: usize) -> i32 {
    let mut path = Vec::new();
    for row in 0..count {
        // Safety: as this function's; no address is computed from null.
        let state = match rows.is_null() {
            true => None,
            false => unsafe { state(rows.wrapping_add(row * length), length) },
        };
        match state {
            Some(state) => path.push(state.to_vec()),
            None => return NO_STATE,
        }
    }
    as_flag(path::verify(&*SCENE, &path).is_ok())
}

fn as_flag(free: bool) -> i32 {
    match free {
        true => FREE,
        false => NOT_FREE,
    }
}

/// The row at an address; None if it cannot be a state.
///
/// # Safety
/// `row` is null or the address of `length` numbers, which stay as they are as long as the answer is used.
unsafe fn state<'a>(row: *const f64, length: usize) -> Option<&'a [f64]> {
    if row.is_null() || length != SCENE.space().coordinates() {
        return None;
    }
    // Safety: as this function's.
    let row = unsafe { slice::from_raw_parts(row, length) };
    row.iter().all(|number| number.is_finite()).then_some(row)
}
