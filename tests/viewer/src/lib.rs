//! A browser without a window, driven over the WebDriver protocol (W3C), which is JSON over HTTP.
//!
//! `chromedriver` and Chromium or Chrome must be there; `tests/run` installs them. WebGL is drawn by SwiftShader, in
//! software, so that no graphics card is needed.

use base64::Engine;
use image::RgbImage;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// How long anything may take.
const PATIENCE: Duration = Duration::from_secs(60);

/// The key under which WebDriver names an element.
const ELEMENT: &str = "element-6066-11e4-a52e-4f735466cecf";

/// What kind of screen and machine to be.
#[derive(Clone, Copy, Debug)]
pub struct Screen {
    /// CSS pixels.
    pub size: [u32; 2],
    /// A telephone, with touch and two pixels to the CSS pixel.
    pub phone: bool,
    /// With WebGL.
    pub webgl: bool,
}

/// A screen on a desk.
pub const DESK: Screen = Screen { size: [1280, 800], phone: false, webgl: true };

/// A browser with one window.
#[derive(Debug)]
pub struct Browser {
    driver: Child,
    port: u16,
    session: String,
}

impl Browser {
    /// Starts one.
    ///
    /// # Panics
    /// If there is no `chromedriver`, or it starts no browser.
    pub fn start(screen: Screen) -> Self {
        let driver = Command::new("chromedriver").arg("--port=0").stdout(Stdio::piped()).process_group(0).spawn();
        let mut driver = driver.expect("chromedriver starts (tests/run --install)");
        let said = BufReader::new(driver.stdout.take().expect("a pipe"));
        let mut browser = Self { driver, port: 0, session: String::new() };
        let port = said
            .lines()
            .map_while(Result::ok)
            .find_map(|line| line.split_once("started successfully on port ")?.1.trim_end_matches('.').parse().ok());
        browser.port = port.expect("chromedriver names its port");
        let [width, height] = screen.size;
        // The sandbox needs rights that a container may lack; the pages are our own.
        let mut arguments = vec!["--headless=new".to_owned(), "--no-sandbox".into(), "--hide-scrollbars".into()];
        // Containers often give shared memory little room.
        arguments.push("--disable-dev-shm-usage".into());
        arguments.push(format!("--window-size={width},{height}"));
        if screen.webgl {
            arguments.extend(["--use-angle=swiftshader".into(), "--enable-unsafe-swiftshader".into()]);
        } else {
            arguments.push("--disable-3d-apis".into());
        }
        let mut options = json!({ "args": arguments });
        if screen.phone {
            let metrics = json!({ "width": width, "height": height, "pixelRatio": 2, "touch": true });
            options["mobileEmulation"] = json!({ "deviceMetrics": metrics });
        }
        let wanted = json!({ "goog:chromeOptions": options, "goog:loggingPrefs": { "browser": "ALL" } });
        let started = browser.send("POST", "/session", &json!({ "capabilities": { "alwaysMatch": wanted } }));
        let id = started["sessionId"].as_str().unwrap_or_else(|| panic!("no session: {started}"));
        browser.session = format!("/session/{id}");
        browser
    }

    /// Opens a file, as a reader who double-clicks it does, and waits until its page says that it is ready.
    ///
    /// # Panics
    /// If that takes too long.
    pub fn open(&self, path: &Path) {
        self.command("url", &json!({ "url": format!("file://{}", path.display()) }));
        self.wait("return document.body.dataset.ready === 'true'");
    }

    /// What a script returns, in the page.
    pub fn run(&self, script: &str) -> Value {
        self.command("execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script returns true.
    ///
    /// # Panics
    /// If that takes too long.
    pub fn wait(&self, script: &str) {
        let start = Instant::now();
        while self.run(script) != true {
            assert!(start.elapsed() < PATIENCE, "{script}: never true; the page said {:?}", self.said());
            std::thread::sleep(Duration::from_millis(30));
        }
    }

    /// Clicks the element of a CSS selector with the pointer; what covers it would get the click.
    pub fn click(&self, selector: &str) {
        let element = self.element(selector);
        self.command(&format!("element/{element}/click"), &json!({}));
    }

    /// Types into the element of a CSS selector.
    pub fn press(&self, selector: &str, keys: &str) {
        let element = self.element(selector);
        self.command(&format!("element/{element}/value"), &json!({ "text": keys }));
    }

    /// Moves a mouse to a place in the window, in CSS pixels.
    pub fn point(&self, [x, y]: [f64; 2]) {
        let moving = json!({ "type": "pointerMove", "duration": 0, "x": x.round() as i64, "y": y.round() as i64 });
        self.act("mouse", &json!([moving]));
    }

    /// Touches a place in the window with a finger.
    pub fn tap(&self, [x, y]: [f64; 2]) {
        let moving = json!({ "type": "pointerMove", "duration": 0, "x": x.round() as i64, "y": y.round() as i64 });
        let touch = json!([moving, { "type": "pointerDown", "button": 0 }, { "type": "pointerUp", "button": 0 }]);
        self.act("touch", &touch);
    }

    /// Drags the mouse from one place to another.
    pub fn drag(&self, from: [f64; 2], to: [f64; 2]) {
        let moving = |[x, y]: [f64; 2], duration: u32| json!({ "type": "pointerMove", "duration": duration, "x": x.round() as i64, "y": y.round() as i64 });
        let (down, up) = (json!({ "type": "pointerDown", "button": 0 }), json!({ "type": "pointerUp", "button": 0 }));
        self.act("mouse", &json!([moving(from, 0), down, moving(to, 100), up]));
    }

    /// Makes the system's colour scheme "light" or "dark".
    pub fn prefer(&self, scheme: &str) {
        let features = json!([{ "name": "prefers-color-scheme", "value": scheme }]);
        let parameters = json!({ "features": features });
        self.command("goog/cdp/execute", &json!({ "cmd": "Emulation.setEmulatedMedia", "params": parameters }));
    }

    fn act(&self, kind: &str, actions: &Value) {
        let source = json!({
            "type": "pointer", "id": kind, "parameters": { "pointerType": kind }, "actions": actions,
        });
        self.command("actions", &json!({ "actions": [source] }));
    }

    /// What the window shows.
    ///
    /// # Panics
    /// If the browser sends no PNG.
    pub fn picture(&self) -> RgbImage {
        let sent = self.send("GET", &format!("{}/screenshot", self.session), &Value::Null);
        let png = base64::engine::general_purpose::STANDARD.decode(sent.as_str().expect("text")).expect("base64");
        image::load_from_memory(&png).expect("a PNG").into_rgb8()
    }

    /// What the page wrote to the console since the last call, warnings and errors of the browser among it.
    pub fn said(&self) -> Vec<String> {
        let log = self.command("se/log", &json!({ "type": "browser" }));
        let entries = log.as_array().into_iter().flatten();
        entries.map(|entry| format!("{} {}", entry["level"], entry["message"])).collect()
    }

    fn element(&self, selector: &str) -> String {
        let found = self.command("element", &json!({ "using": "css selector", "value": selector }));
        found[ELEMENT].as_str().expect("an element").to_owned()
    }

    fn command(&self, name: &str, body: &Value) -> Value {
        self.send("POST", &format!("{}/{name}", self.session), body)
    }

    /// The value of the driver's answer.
    fn send(&self, method: &str, path: &str, body: &Value) -> Value {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("chromedriver listens");
        stream.set_read_timeout(Some(2 * PATIENCE)).expect("a time");
        let body = if body.is_null() { String::new() } else { body.to_string() };
        let head = format!("{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {}\r\n\r\n", body.len());
        stream.write_all((head + &body).as_bytes()).expect("chromedriver reads");
        let mut answer = BufReader::new(stream);
        let mut length = 0;
        loop {
            let mut line = String::new();
            answer.read_line(&mut line).expect("chromedriver answers");
            if line.trim().is_empty() {
                break;
            }
            if let Some((name, value)) = line.split_once(':').filter(|(n, _)| n.eq_ignore_ascii_case("content-length"))
            {
                length = value.trim().parse().unwrap_or_else(|_| panic!("{name}: {value}"));
            }
        }
        let mut bytes = vec![0; length];
        answer.read_exact(&mut bytes).expect("the whole answer");
        let mut answer: Value = serde_json::from_slice(&bytes).expect("JSON");
        let value = answer["value"].take();
        assert!(value.get("error").is_none(), "{method} {path}: {}: {}", value["error"], value["message"]);
        value
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The browser belongs to the driver's group, and outlives the driver alone. Nobody is left to tell of failures.
        let group = format!("-{}", self.driver.id());
        let _ = Command::new("kill").args(["-KILL", "--", &group]).status();
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
