// What the viewer uses of three.js.
export {
    BufferAttribute, BufferGeometry, CanvasTexture, Color, DataTexture, DoubleSide, GLSL3, Group, LineBasicMaterial,
    LineSegments, Mesh, MeshBasicMaterial, PerspectiveCamera, PlaneGeometry, RawShaderMaterial, REVISION, Scene, Vector3,
    WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
