//! Shaders on a Vulkan adapter: buffers in, one buffer out.

use crate::Failure;
use std::cell::RefCell;
use std::collections::HashMap;
use wgpu::util::DeviceExt;

/// Where the shaders lie, a file for each. Each computes one element of its output per invocation, from a struct of shapes
/// and its inputs, in the order of their bindings.
const SHADERS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/shaders");

/// Invocations of a workgroup, in every shader.
const GROUP: u32 = 64;
/// Workgroups along the first axis of a dispatch, at most.
const GROUPS: u32 = 65_535;

/// Numbers of 32 bits in the adapter's memory.
#[derive(Clone, Debug)]
pub struct Buffer {
    inner: wgpu::Buffer,
    len: usize,
}

impl Buffer {
    /// How many numbers.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none. A buffer never is empty.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}

/// An adapter, its queue and the shaders compiled so far.
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: wgpu::AdapterInfo,
    pipelines: RefCell<HashMap<&'static str, wgpu::ComputePipeline>>,
}

impl Gpu {
    /// Opens a Vulkan adapter: the first that is there, be it a GPU or software.
    ///
    /// # Errors
    /// If there is none, naming what to install; if it cannot be opened.
    pub fn open() -> Result<Self, Failure> {
        pollster::block_on(async {
            let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
            descriptor.backends = wgpu::Backends::VULKAN;
            let instance = wgpu::Instance::new(descriptor);
            let adapter = instance.request_adapter(&wgpu::RequestAdapterOptions::default()).await.map_err(|e| {
                Failure(format!(
                    "no Vulkan adapter, expected a GPU or the software adapter of the Debian package mesa-vulkan-drivers \
                     (apt-get install mesa-vulkan-drivers, or run tests/run): {e}"
                ))
            })?;
            let info = adapter.get_info();
            let descriptor = wgpu::DeviceDescriptor { required_limits: wgpu::Limits::default(), ..Default::default() };
            let (device, queue) = adapter
                .request_device(&descriptor)
                .await
                .map_err(|e| Failure(format!("the adapter {} cannot be opened: {e}", info.name)))?;
            Ok(Self { device, queue, info, pipelines: RefCell::default() })
        })
    }

    /// Name of the adapter.
    pub fn adapter(&self) -> &str {
        &self.info.name
    }

    /// Name and version of its driver.
    pub fn driver(&self) -> String {
        format!("{} {}", self.info.driver, self.info.driver_info).trim().to_owned()
    }

    /// A buffer of `numbers`, which are f32, i32 or u32.
    ///
    /// # Panics
    /// If there are none, or more than a binding may have (128 MiB).
    pub fn upload<T: bytemuck::NoUninit>(&self, numbers: &[T]) -> Buffer {
        let len = self.check(std::mem::size_of_val(numbers) / 4);
        let inner = self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: None,
            contents: bytemuck::cast_slice(numbers),
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
        });
        Buffer { inner, len }
    }

    /// A buffer of `len` zeros.
    ///
    /// # Panics
    /// As [`Gpu::upload`].
    pub fn zeros(&self, len: usize) -> Buffer {
        let inner = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: self.check(len) as u64 * 4,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Buffer { inner, len }
    }

    fn check(&self, len: usize) -> usize {
        let most = self.device.limits().max_storage_buffer_binding_size / 4;
        assert!(len > 0 && len as u64 <= most, "a buffer of {len} numbers, expected 1 to {most}");
        len
    }

    /// Copies `len` numbers from `source`, `from` on, to `target`, `to` on.
    pub fn copy(&self, source: &Buffer, from: usize, target: &Buffer, to: usize, len: usize) {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let [from, to, len] = [from, to, len].map(|v| v as u64 * 4);
        encoder.copy_buffer_to_buffer(&source.inner, from, &target.inner, to, len);
        self.queue.submit([encoder.finish()]);
    }

    /// Runs `shader` on `inputs`, into a new buffer of `len` numbers. `shape` are the words of the shader's first binding,
    /// laid out as WGSL says: a vec3 takes four words.
    ///
    /// # Panics
    /// If there is no such shader, or it has other bindings.
    pub fn run(&self, shader: &'static str, shape: &[u32], inputs: &[&Buffer], len: usize) -> Buffer {
        let output = self.zeros(len);
        let shape = self.upload(shape);
        let mut pipelines = self.pipelines.borrow_mut();
        let pipeline = pipelines.entry(shader).or_insert_with(|| self.compile(shader));
        let bindings = std::iter::once(&shape).chain(inputs.iter().copied()).chain([&output]);
        let entries: Vec<wgpu::BindGroupEntry<'_>> = bindings
            .enumerate()
            .map(|(i, b)| wgpu::BindGroupEntry { binding: i as u32, resource: b.inner.as_entire_binding() })
            .collect();
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(shader),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &group, &[]);
            let groups = (len as u32).div_ceil(GROUP);
            pass.dispatch_workgroups(groups.min(GROUPS), groups.div_ceil(GROUPS), 1);
        }
        self.queue.submit([encoder.finish()]);
        output
    }

    fn compile(&self, name: &str) -> wgpu::ComputePipeline {
        let read = |name: &str| {
            let path = format!("{SHADERS}/{name}.wgsl");
            std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{path}: {e}"))
        };
        let rules = if name.ends_with("_i8") { read("quantised") } else { String::new() };
        let source = rules + &read(name);
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(name),
            source: wgpu::ShaderSource::Wgsl(source.into()),
        });
        self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(name),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        })
    }

    /// The numbers of `buffer`.
    ///
    /// # Panics
    /// If the adapter is lost.
    pub fn read<T: bytemuck::AnyBitPattern>(&self, buffer: &Buffer) -> Vec<T> {
        let size = buffer.len as u64 * 4;
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&buffer.inner, 0, &staging, 0, size);
        self.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |result| result.expect("memory that can be mapped"));
        self.device.poll(wgpu::PollType::wait_indefinitely()).expect("the adapter is there");
        let view = staging.get_mapped_range(..).expect("it is mapped");
        view.chunks_exact(4).map(bytemuck::pod_read_unaligned).collect()
    }
}
