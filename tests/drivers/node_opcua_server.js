/* A controller behind node-opcua's server, for the tests: nobody's own code here but its program and its plant.
 *
 *   node node_opcua_server.js PORT FOLDER     prints "ready" when it serves; FOLDER takes its certificates, and has
 *                                             certificates/host.pem, the only one that it trusts
 *
 * Program, every 10 ms: while enable is true and the heartbeat moves, u is the output; after half a second without a
 * new heartbeat, or with enable false, the safe output, or the PI where automatic is true. The plant has two lags of
 * 1.2 and .5 s. Signed and encrypted connections only, user "operator" with the password "right".
 */
const { OPCUAServer, Variant, DataType, StatusCodes, SecurityPolicy, MessageSecurityMode, OPCUACertificateManager } =
  require("node-opcua");

const { readFileSync } = require("fs");
const { X509Certificate } = require("crypto");

const [port, folder] = [Number(process.argv[2]), process.argv[3]];
const held = { u: 0, heartbeat: 0, safe: 0, enable: false, automatic: false, setpoint: 0, load: 0, K: 0.1, Ti: 1 };
let x1 = 0, y = 0, output = 0, integral = 0, beat = -1, fed = 0, mode = "idle";

function scan(dt, t) {
  if (held.heartbeat !== beat || !held.enable) { beat = held.heartbeat; fed = t; }
  if (held.enable && t - fed > 0.5) held.enable = false;
  const next = held.enable ? "host" : held.automatic ? "own" : "idle";
  const e = held.setpoint - y;
  if (next === "own" && mode !== "own") integral = output - held.K * e;
  mode = next;
  if (mode === "own") { integral += (held.K / held.Ti) * e * dt; output = held.K * e + integral + held.load; }
  else output = mode === "host" ? held.u : held.safe;
  output = Math.min(10, Math.max(0, output));
  x1 += (1 - Math.exp(-dt / 1.2)) * (output - x1);
  y += (1 - Math.exp(-dt / 0.5)) * (x1 - y);
}

(async () => {
  const certificates = (name) => new OPCUACertificateManager({ automaticallyAcceptUnknownCertificate: false, rootFolder: folder + "/" + name });
  const peers = certificates("pki");
  await peers.initialize();
  await peers.trustCertificate(new X509Certificate(readFileSync(folder + "/certificates/host.pem")).raw);
  const server = new OPCUAServer({
    port, resourcePath: "/rig", allowAnonymous: false,
    serverCertificateManager: peers, userCertificateManager: certificates("users"),
    securityPolicies: [SecurityPolicy.Basic256Sha256], securityModes: [MessageSecurityMode.SignAndEncrypt],
    userManager: { isValidUser: (user, password) => user === "operator" && password === "right" },
  });
  await server.initialize();
  const space = server.engine.addressSpace.getOwnNamespace();
  const rig = space.addObject({ organizedBy: server.engine.addressSpace.rootFolder.objects, browseName: "Rig" });
  const add = (name, dataType, get, set) => space.addVariable({
    componentOf: rig, browseName: name, nodeId: "s=" + name, dataType, minimumSamplingInterval: 10,
    accessLevel: set ? "CurrentRead | CurrentWrite" : "CurrentRead", userAccessLevel: set ? "CurrentRead | CurrentWrite" : "CurrentRead",
    value: { get: () => new Variant({ dataType: DataType[dataType], value: get() }),
             ...(set ? { set: (variant) => { set(variant.value); return StatusCodes.Good; } } : {}) },
  });
  add("y", "Double", () => y + 1e-3 * (2 * Math.random() - 1));
  add("u_applied", "Double", () => output);
  add("heartbeat_echo", "UInt16", () => held.heartbeat);
  add("in_command", "Boolean", () => mode === "host");
  for (const [name, type] of Object.entries({ u: "Double", heartbeat: "UInt16", safe: "Double", enable: "Boolean",
    automatic: "Boolean", setpoint: "Double", load: "Double", K: "Float", Ti: "Double" }))
    add(name, type, () => held[name], (value) => { held[name] = value; });
  await server.start();
  let before = process.hrtime.bigint();
  setInterval(() => {
    const now = process.hrtime.bigint(), dt = Number(now - before) * 1e-9;
    before = now;
    for (let left = dt; left > 1e-6; left -= 0.01) scan(Math.min(left, 0.01), Number(now) * 1e-9);
  }, 10);
  console.log("ready " + space.index);
})().catch((error) => { console.error(error); process.exit(1); });
