// What the service's own page takes of this package.
export { PrivateClient } from "../dist/service/private-client.js";
