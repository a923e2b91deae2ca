//! The files of the dashboard page, compiled into the program; `mod.rs` serves them. A new file of `page/` needs an
//! entry here.

/// Declares files of `page/` with one content type.
macro_rules! files {
    ($($content_type:literal: $($name:literal)+;)+) => {
        &[$($((concat!("/", $name), $content_type, include_str!(concat!("page/", $name))),)+)+]
    };
}

/// The files of the page: path, content type, content. `mod.rs` serves `/index.html` as `/`.
pub(super) const PAGE: &[(&str, &str, &str)] = files! {
    "text/html; charset=utf-8": "index.html";
    "text/css; charset=utf-8": "layout.css" "style.css";
    "text/javascript; charset=utf-8":
        "address.js" "api.js" "axis.js" "chart.js" "charts.js" "clock.js" "compare.js" "device_actions.js"
        "device_panel.js" "events_panel.js" "export.js" "files.js" "histogram.js" "keys.js" "main.js" "map.js"
        "map_devices.js" "map_ground.js" "map_panel.js" "map_symbols.js" "messages.js" "page_state.js" "run_state.js"
        "states.js" "theme.js" "timeline.js" "timeline_data.js" "timeline_filter.js" "timeline_panel.js"
        "timeline_tile.js" "timeline_window.js" "visibility.js";
};
