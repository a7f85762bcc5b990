//! `[lightfield]`: a light-field microscope, in place of `[optics]`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where the light-field microscope is described.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LightField {
    /// Setup file of `daic lightfield init`; relative paths start at the dataset.
    pub setup: String,
}
