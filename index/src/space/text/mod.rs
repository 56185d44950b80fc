//! The text form of a space, read and printed.
//!
//! ```text
//! space   = preset | "sum" "(" product { "," product } ")" | product
//! product = item { "*" item }
//! item    = ( factor | "(" product ")" ) [ ":" weight ] [ "^" count ]
//! factor  = "R" n | "SO2" [ "[" period "]" ] | "SO3"            (S1 and RP3 are read as SO2 and SO3)
//! ```
//!
//! A product is flat: the weight of a parenthesised product within one multiplies the weights of its factors, which
//! multiply squared distances. An argument of `sum` that is one item makes as many groups as its count says, whose
//! weight, which multiplies a distance, is the item's; one of several items makes one group of weight 1.

mod parse;
mod print;

pub(super) use parse::parse;
pub(super) use print::print;
