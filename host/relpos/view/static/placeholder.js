const address = location.origin.replace(/^http/, "ws") + "/ws";
function connect() {
  const socket = new WebSocket(address);
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "picture") {
      document.getElementById("picture").textContent = JSON.stringify(message, null, 1);
    }
  };
  socket.onclose = () => setTimeout(connect, 1000);
}
connect();
