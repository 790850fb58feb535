//! What a camera sees of a world: colours, and per pixel the class and the distance.

use super::camera::Pinhole;
use super::culling::{Culling, Shadows};
use super::solid::Part;
use super::street::class;
use super::texture::{pick, smooth};
use super::world::World;
use crate::base::random::Random;
use crate::scene::Image;
use glam::{Vec2, Vec3};

/// Metres from the ground to the lidar, the origin of its frame.
pub(super) const LIDAR_HEIGHT: f32 = 1.84;

/// Class of pixels that see the sky.
pub const SKY: u8 = 255;

/// Metres beyond which nothing is seen.
const HORIZON: f32 = 140.0;

/// Metres beyond which nothing casts a shadow.
const SHADOW: f32 = 45.0;

/// Images up to this many pixels wide get more samples where surfaces meet; in wider ones no edge needs them.
const SMALL: usize = 900;

/// Sun, sky, air and sensor of one world.
#[derive(Clone, Debug)]
pub(super) struct Light {
    /// Direction to the sun, a unit vector.
    sun: Vec3,
    direct: Vec3,
    ambient: Vec3,
    zenith: Vec3,
    horizon: Vec3,
    /// Share of the sky that clouds cover.
    clouds: f32,
    /// Metres at which haze hides half of the light.
    haze: f32,
    exposure: Vec3,
    /// Standard deviation of the sensor's noise.
    noise: f32,
    salt: u32,
}

/// What one camera sees.
#[derive(Clone, Debug)]
pub struct CameraView {
    /// The image.
    pub image: Image,
    /// Per pixel the class of what it sees; 255 for the sky.
    pub classes: Vec<u8>,
    /// Per pixel the metres to it along the optical axis; infinite for the sky.
    pub depths: Vec<f32>,
}

/// What a ray meets.
#[derive(Clone, Copy)]
struct Sample {
    colour: Vec3,
    class: u8,
    distance: f32,
    /// Differs between surfaces.
    surface: u32,
}

impl Light {
    pub(super) fn new(random: &mut Random) -> Self {
        let mut around = Vec2::new(random.range(-1.0, 1.0), random.range(-1.0, 1.0));
        if around.length_squared() < 0.02 {
            around = Vec2::X;
        }
        let kind = random.below(10);
        // Clear days, grey ones, and evenings with a low sun.
        let up = if kind >= 8 { random.range(0.12, 0.3) } else { random.range(0.4, 1.6) };
        let sun = around.normalize().extend(up).normalize();
        let (direct, ambient, clouds) = match kind {
            0..5 => (Vec3::new(0.72, 0.66, 0.55), Vec3::new(0.44, 0.48, 0.54), random.range(0.1, 0.5)),
            5..8 => (Vec3::splat(random.range(0.0, 0.18)), Vec3::new(0.68, 0.71, 0.74), random.range(0.75, 1.0)),
            _ => (Vec3::new(0.78, 0.52, 0.30), Vec3::new(0.38, 0.38, 0.46), random.range(0.1, 0.6)),
        };
        let zenith = match kind {
            5..8 => Vec3::splat(random.range(0.6, 0.85)),
            _ => Vec3::new(0.30, 0.50, 0.82) * random.range(0.8, 1.1),
        };
        let horizon = match kind {
            8.. => Vec3::new(0.94, 0.74, 0.56),
            _ => Vec3::new(0.80, 0.85, 0.90),
        };
        let tint = Vec3::new(random.range(0.94, 1.06), 1.0, random.range(0.94, 1.06));
        Self {
            sun,
            direct,
            ambient,
            zenith,
            horizon,
            clouds,
            haze: pick(random, &[400.0, 220.0, 140.0, 80.0]),
            exposure: tint * random.range(0.75, 1.2),
            noise: random.range(0.004, 0.022),
            salt: random.next_u64() as u32,
        }
    }

    fn sky(&self, ray: Vec3) -> Vec3 {
        let up = ray.z.max(0.0);
        let blue = self.horizon.lerp(self.zenith, (up * (2.2 - 1.2 * up)).min(1.0));
        let glow = ray.dot(self.sun).max(0.0);
        let glow = glow * glow * glow * glow;
        let blue = blue + self.direct * (0.3 * glow * glow);
        // A layer of clouds overhead, seen flat towards the horizon.
        let at = ray.truncate() / (up + 0.12) * 1.6;
        let cover = |cloud: f32| ((cloud - 1.0 + self.clouds) * 4.0).clamp(0.0, 1.0);
        let coarse = 0.65 * smooth(at.x, at.y, self.salt);
        // Where the fine pattern, from 0 to 0.35, decides nothing, it is not asked; with some room for rounding.
        let (least, most) = (cover(coarse - 1e-3), cover(coarse + 0.351));
        let open = least != most;
        let fine = if open { 0.35 * smooth(at.x * 2.7, at.y * 2.7, self.salt ^ 1) } else { 0.0 };
        let cover = if open { cover(coarse + fine) } else { most };
        blue.lerp(self.ambient * 1.25, cover * 0.85)
    }
}

impl World {
    /// From vehicle coordinates, with the lidar as origin, to the world's: a direction.
    pub(super) fn turned(&self, v: Vec3) -> Vec3 {
        let Vec2 { x: c, y: s } = self.ego.1;
        Vec3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
    }

    /// From vehicle coordinates to the world's: a point.
    pub(super) fn placed(&self, v: Vec3) -> Vec3 {
        self.ego.0 + Vec3::Z * LIDAR_HEIGHT + self.turned(v)
    }

    fn sample(&self, light: &Light, shadows: Option<&Shadows>, culling: &mut Culling, ray: Vec3) -> Sample {
        let origin = culling.origin();
        let ground = self.street.hit(origin, ray, HORIZON);
        let object = culling.hit(ray, ground.unwrap_or(HORIZON));
        let (distance, normal, base, class, surface) = match (object, ground) {
            (Some((number, part, hit)), _) => {
                let object = &self.objects[number];
                let at = object.inwards(origin + ray * hit.distance - object.at);
                let Part { colour, finish, .. } = object.parts[part];
                let base = finish.colour(colour, at, object.inwards(hit.normal), number as u32);
                // Faces of a part differ as parts do.
                let face = hit.normal.dot(Vec3::new(1.0, 3.0, 9.0)) * 4.0;
                let surface = (number as u32) << 16 | (part as u32) << 8 | (face as i32 & 255) as u32;
                (hit.distance, hit.normal, base, object.class, surface)
            }
            (None, Some(distance)) => {
                let at = (origin + ray * distance).truncate();
                let (class, base) = self.street.surface(at, distance);
                (distance, self.street.normal(at), base, class, u32::MAX - u32::from(class))
            }
            (None, None) => {
                let colour = light.sky(ray);
                return Sample { colour, class: SKY, distance: f32::INFINITY, surface: u32::MAX };
            }
        };
        let at = origin + ray * distance + normal * (2e-3 * (1.0 + distance * 0.1));
        let facing = normal.dot(light.sun).max(0.0);
        let lit = facing > 0.0 && shadows.is_some_and(|shadows| !shadows.at(at));
        let sun = if lit { facing } else { 0.0 };
        let colour = base * (light.ambient * (0.8 + 0.2 * normal.z) + light.direct * sun);
        let haze = distance * distance / (distance * distance + light.haze * light.haze);
        let colour = colour.lerp(light.sky(Vec3::new(ray.x, ray.y, ray.z.abs() * 0.2)), haze);
        Sample { colour, class, distance, surface }
    }

    /// What keeps the sun from where; none on a day without sun.
    pub(super) fn shadows(&self, light: &Light) -> Option<Shadows<'_>> {
        (light.direct.x > 0.02).then(|| Shadows::new(self, light.sun, SHADOW))
    }

    /// What a camera sees. `seed` is of the sensor's noise.
    pub(super) fn view(&self, light: &Light, shadows: Option<&Shadows>, camera: &Pinhole, seed: u64) -> CameraView {
        let [height, width] = camera.size;
        let cast = |culling: &mut Culling, u: f64, v: f64| {
            let ray = self.turned(camera.ray(u, v).as_vec3());
            let length = ray.length();
            (self.sample(light, shadows, culling, ray / length), length)
        };
        let mut culling = Culling::new(self, camera);
        let (mut classes, mut depths) = (vec![SKY; height * width], vec![f32::INFINITY; height * width]);
        let (mut surfaces, mut colours) = (vec![0u32; height * width], vec![Vec3::ZERO; height * width]);
        culling.pixels(|culling, u, v| {
            let (sample, length) = cast(culling, u as f64, v as f64);
            let pixel = v * width + u;
            (classes[pixel], depths[pixel]) = (sample.class, sample.distance / length);
            (surfaces[pixel], colours[pixel]) = (sample.surface, sample.colour);
        });
        if width <= SMALL {
            culling.pixels(|culling, u, v| {
                let pixel = v * width + u;
                let other = |near: bool, at: usize| near && surfaces[at] != surfaces[pixel];
                let edge = other(u > 0, pixel.wrapping_sub(1))
                    || other(u + 1 < width, pixel + 1)
                    || other(v > 0, pixel.wrapping_sub(width))
                    || other(v + 1 < height, pixel + width);
                if edge {
                    for (du, dv) in [(0.33, 0.12), (-0.12, 0.33), (-0.33, -0.12), (0.12, -0.33)] {
                        colours[pixel] += cast(culling, u as f64 + du, v as f64 + dv).0.colour;
                    }
                    colours[pixel] *= 0.2;
                }
            });
        }
        let mut random = Random::new(seed);
        let mut bgr = vec![0u8; height * width * 3];
        for (pixel, &colour) in colours.iter().enumerate() {
            let grain = Vec3::new(random.normal(), random.normal(), random.normal()) * light.noise;
            // A camera's curve: shadows are lifted, lights compressed.
            let exposed = (colour * light.exposure).max(Vec3::ZERO);
            let toned = exposed * 1.45 / (exposed + Vec3::splat(0.45)) + grain;
            let toned = toned.clamp(Vec3::ZERO, Vec3::ONE) * 255.0 + 0.5;
            bgr[3 * pixel..3 * pixel + 3].copy_from_slice(&[toned.z as u8, toned.y as u8, toned.x as u8]);
        }
        CameraView { image: Image { height, width, bgr }, classes, depths }
    }

    /// The class that the ground has at a point of the world.
    pub(super) fn ground(&self, at: Vec2) -> u8 {
        let (class, _) = self.street.surface(at, 0.0);
        debug_assert!((class::DRIVEABLE..=class::TERRAIN).contains(&class));
        class
    }
}
