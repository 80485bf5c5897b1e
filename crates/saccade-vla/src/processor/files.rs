//! The options of a processor in the files beside a checkpoint: Isaac-GR00T's, and lerobot's saved steps.

use std::path::Path;

use serde_json::{Value, json};

use super::options::is_read;
use super::settings::{LEROBOT_CROP, LEROBOT_TARGET};
use crate::config::{Object, asks_for_nothing, object_in_any};
use crate::error::{Error, Result, ensure, problem};
use crate::release::{IsaacFile, LerobotRules, PIXEL_LIMITS, Preprocessing, ProcessorRules, Version};

const PROCESSOR: &str = "processor_config.json";
const PIPELINE: &str = "policy_preprocessor.json";

/// Steps that leave frames and words as they are.
const OTHER_STEPS: [&str; 5] = [
    "delta_actions_processor",
    "device_processor",
    "relative_actions_processor",
    "rename_observations_processor",
    "to_batch_processor",
];

/// The options in the files of a checkpoint that are read here.
///
/// # Errors
/// [`Error::Checkpoint`] and [`Error::Json`] for files that are broken, and for keys and steps that their
/// release does not know.
pub(super) fn options(
    version: Version,
    rules: &ProcessorRules,
    preprocessing: Preprocessing,
    directory: &Path,
) -> Result<Object> {
    let file = rules.isaac_file.as_ref();
    let mut options = match (preprocessing, &version.release().lerobot) {
        (Preprocessing::Isaac, _) => isaac(version, file, directory)?,
        (Preprocessing::Lerobot, Some(lerobot)) => lerobot_steps(version, lerobot, file, directory)?,
        (Preprocessing::Lerobot, None) => Object::new(),
    };
    options.retain(|key, _| is_read(&rules.views, key));
    if rules.has_pixel_limits() {
        add_pixel_limits(&mut options, directory)?;
    }
    Ok(options)
}

/// Adds the least and the greatest area that the `preprocessor_config.json` in `folder` has, if they are not
/// there yet.
///
/// # Errors
/// [`Error::Checkpoint`] and [`Error::Json`] for a file that is broken.
pub(super) fn add_pixel_limits(options: &mut Object, folder: &Path) -> Result<()> {
    let Some(file) = object_in_any("source", &folder.join(PIXEL_LIMITS))? else {
        return Ok(());
    };
    for (key, value) in file {
        if ["min_pixels", "max_pixels", "size"].contains(&key.as_str()) {
            options.entry(key).or_insert(value);
        }
    }
    Ok(())
}

/// What the file of Isaac-GR00T's processor says; nothing where there is none.
fn isaac(version: Version, released: Option<&IsaacFile>, directory: &Path) -> Result<Object> {
    let Some(mut kwargs) = processor_kwargs(version, released, directory)? else {
        return Ok(Object::new());
    };
    // The default of the released constructors.
    kwargs.entry("use_albumentations").or_insert(json!(false));
    Ok(kwargs)
}

/// The `processor_kwargs` of a checkpoint whose release has them: in the folder itself, and where that has
/// none in `processor/`, which is where training leaves them.
fn processor_kwargs(
    version: Version,
    released: Option<&IsaacFile>,
    directory: &Path,
) -> Result<Option<Object>> {
    let Some(released) = released else {
        return Ok(None);
    };
    let is_argument = |key: &str| released.arguments.iter().any(|keys| keys.contains(&key));
    for folder in ["", "processor"] {
        let path = directory.join(folder).join(PROCESSOR);
        let Some(mut file) = object_in_any("source", &path)? else {
            continue;
        };
        let mut kwargs = match file.remove("processor_kwargs") {
            Some(Value::Object(kwargs)) => kwargs,
            Some(_) => return refused(&path, "processor_kwargs: expected an object"),
            // Another program's file of this name holds nothing of it.
            None => continue,
        };
        if let Some(class) = file.get("processor_class").filter(|class| !class.is_null())
            && class != released.class
        {
            let what = format!(
                "processor_class: expected {}, since the tensors are those of {version}, got {class}",
                released.class
            );
            return refused(&path, &what);
        }
        check_keys(&path, "processor_kwargs", &kwargs, &is_argument)?;
        // What another version calls by this name says nothing here, also where it is false.
        kwargs.retain(|key, _| is_argument(key));
        return Ok(Some(kwargs));
    }
    Ok(None)
}

/// What lerobot's saved steps say. Without them: what lerobot makes of a raw checkpoint.
fn lerobot_steps(
    version: Version,
    rules: &LerobotRules,
    file: Option<&IsaacFile>,
    directory: &Path,
) -> Result<Object> {
    let path = directory.join(PIPELINE);
    let steps = match object_in_any("source", &path)?.map(|mut file| file.remove("steps")) {
        None if rules.has_view_sizes => {
            return Ok(as_lerobot_writes(
                processor_kwargs(version, file, directory)?.unwrap_or_default(),
            ));
        }
        None => return Ok(Object::new()),
        Some(Some(Value::Array(steps))) => steps,
        Some(_) => return refused(&path, "steps: expected a list"),
    };
    let mut options = match rules.has_view_sizes {
        true => as_lerobot_writes(Object::new()),
        false => Object::new(),
    };
    let released = Version::all().filter_map(|version| version.release().lerobot.as_ref());
    let released: Vec<_> = released.flat_map(|lerobot| lerobot.steps).collect();
    for (index, step) in steps.iter().enumerate() {
        let name = ["registry_name", "class"]
            .iter()
            .find_map(|key| step.get(key)?.as_str());
        let nothing = Object::new();
        let config = match step.get("config") {
            None | Some(Value::Null) => &nothing,
            Some(Value::Object(config)) => config,
            Some(_) => return refused(&path, &format!("steps[{index}].config: expected an object")),
        };
        let Some(step) = released.iter().find(|step| name == Some(step.name)) else {
            let is_off = config.get("enabled") == Some(&Value::Bool(false));
            if is_off || name.is_some_and(|name| OTHER_STEPS.contains(&name)) {
                continue;
            }
            let known: Vec<&str> = released.iter().map(|step| step.name).chain(OTHER_STEPS).collect();
            let name = name.unwrap_or("a step without a name");
            let what = format!("steps[{index}]: expected one of {}, got {name}", known.join(", "));
            return refused(&path, &what);
        };
        check_keys(&path, step.name, config, &|key| step.keys.contains(&key))?;
        if step.fits_views {
            // Whatever the step leaves out has the default of its class.
            options.extend(object(json!({
                "crop_fraction": null,
                "image_crop_size": null,
                "image_target_size": null,
                "letter_box_transform": false,
                "shortest_image_edge": null,
                "use_albumentations": false,
            })));
        }
        options.extend(config.clone());
    }
    Ok(options)
}

/// What lerobot writes into its steps for an NVIDIA checkpoint with these options.
fn as_lerobot_writes(mut kwargs: Object) -> Object {
    // Sizes of a checkpoint count if it has a target.
    if kwargs.get("image_target_size").is_none_or(Value::is_null) {
        kwargs.extend(object(json!({
            "crop_fraction": null,
            "image_crop_size": LEROBOT_CROP,
            "image_target_size": LEROBOT_TARGET,
            "shortest_image_edge": null,
        })));
    }
    kwargs
}

/// That a config has keys only that its release knows. Others are options that cannot be used, like those
/// with a value that cannot.
fn check_keys(path: &Path, owner: &str, config: &Object, is_known: &dyn Fn(&str) -> bool) -> Result<()> {
    let unknown = config
        .iter()
        .filter(|(key, value)| !is_known(key) && !asks_for_nothing(value));
    let unknown: Vec<&str> = unknown.map(|(key, _)| key.as_str()).collect();
    ensure!(
        unknown.is_empty(), Input, "source";
        "{}: {owner}: {}: expected none: its release has no such option", path.display(), unknown.join(", ")
    );
    Ok(())
}

fn refused<T>(path: &Path, what: &str) -> Result<T> {
    Err(Error::Checkpoint(problem!(
        "source"; "{}: {what}", path.display()
    )))
}

/// The keys of an object; none of anything else.
fn object(value: Value) -> Object {
    match value {
        Value::Object(keys) => keys,
        _ => Object::new(),
    }
}
